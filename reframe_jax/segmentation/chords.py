"""Chords of a whole recording: the same few programs for every length.

A recording is cut into overlapping chunks of one size. Every step that reaches beyond a pose (derivatives,
outliers, chords) reaches less far than the overlap, so the chunks join without seams.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import compiler_options
from reframe_jax.constraints.types import LinearType
from reframe_jax.motion import kinematics
from reframe_jax.motion.noise import choose_lag, estimate_noise
from reframe_jax.motion.outliers import repair_poses

__all__ = ["LONGEST_LAG", "Chords", "Tracks", "cut_chords", "local_paths", "track_poses"]

_CORE, _BEFORE, _AFTER = 384, 8, 120  # poses of a chunk that are its own, and those about them
_SIZE = _BEFORE + _CORE + _AFTER
LONGEST_LAG = _AFTER - _BEFORE  # samples
_BATCH = 8  # chunks computed at once
_MOVING = 0.1  # share of chords that must be long for the others not to count
_REST = 4.0  # noises that a chord must be long not to count as rest


@dataclass(frozen=True)
class Tracks:
    """What chunks of a recording are reduced to.

    Attributes:
        paths: (chunks, size, 4, 3, 4) m and 1 by frame type, see
            :func:`reframe_jax.motion.kinematics.velocity_paths`; each chunk begins a path of its own.
        times: (N,) s.
        positions: (N, 3) m, repaired, about ``centre``.
        centre: (3,) m.
        counted: (N,) bool, poses that are no outliers.
        noise: m and rad, standard deviation of position and orientation.
        lag: samples that a chord should span.
    """

    paths: np.ndarray
    times: np.ndarray
    positions: np.ndarray
    centre: np.ndarray
    counted: np.ndarray
    noise: tuple[float, float]
    lag: int


@dataclass(frozen=True)
class Chords:
    """Velocity of a recording over overlapping chords.

    Attributes:
        maps: (K, 4, 3, 4) m/s and 1/s by frame type: u = a + B p, of the chord that starts at each pose; zero
            for the poses at the end from which none starts.
        moving: (K,) bool, whether the chord counts: both its poses do, and it is longer than noise.
        span: (K,) s, between its poses.
        lag: samples between its poses.
    """

    maps: np.ndarray
    moving: np.ndarray
    span: np.ndarray
    lag: int


@functools.partial(jax.jit, compiler_options=compiler_options())
def _reduce(poses: jax.Array, times: jax.Array, count: jax.Array) -> tuple[jax.Array, ...]:
    """Paths (3, 4, size, 4, B), repaired poses, poses that count (B, size), noise (2, B), and lag (B,)."""
    poses, counted = repair_poses(poses, times, count)
    steps = jnp.diff(times, axis=1)
    maps, paths = kinematics.velocity_paths(poses, steps, count)
    rotation, position = paths[:, 1:, :, LinearType.GB], paths[:, 0, :, LinearType.GB]
    turns = kinematics.rates_of(maps)[:, 0, :, 1] * steps.T[None]
    noise = estimate_noise(position, turns, counted.T)
    lag = choose_lag(rotation, position, counted.T, noise, count)
    return paths, poses, counted, jnp.stack(noise), lag


def track_poses(poses: np.ndarray, times: np.ndarray) -> Tracks:
    """Reduce a recording to paths, its noise, and the length of chords that the noise requires.

    Args:
        poses: (N, 4, 4), m.
        times: (N,) s.
    """
    number = len(poses)
    centre = np.median(poses[:, :3, 3], axis=0)
    poses = poses.copy()
    poses[:, :3, 3] -= centre
    starts = np.arange(0, number, _CORE)
    paths, kept, positions, noises, lags, sizes = [], [], [], [], [], []
    for first in range(0, len(starts), _BATCH):
        own = starts[first : first + _BATCH]
        low = np.maximum(own - _BEFORE, 0)
        # the last chunk reaches back, so that none is too short to be a window
        low = np.maximum(np.minimum(low, number - _BEFORE - 1), 0)
        count = np.minimum(number - low, _SIZE)
        index = low[:, None] + np.arange(_SIZE)
        inside = np.minimum(index, number - 1)
        beyond = (index - inside) * (times[-1] - times[-2])
        fill = np.minimum(np.arange(_BATCH), len(own) - 1)
        arguments = (poses[inside], times[inside] - times[low][:, None] + beyond, count.astype(np.int32))
        found = _reduce(*(a[fill] for a in arguments))
        path, repaired, counted, noise, lag = (np.asarray(x) for x in found)
        for i, start in enumerate(own):
            offset = start - low[i]
            size = min(_CORE, number - start)
            chunk = np.moveaxis(path[..., i], (2, 3), (0, 1))[offset : offset + _CORE + _AFTER]
            paths.append(chunk)
            kept.append(counted[i, offset : offset + size])
            positions.append(repaired[i, offset : offset + size, :3, 3])
            noises.append(noise[:, i])
            lags.append(lag[i])
            sizes.append(size)
    weights = np.asarray(sizes)
    noise_of_all = [_weighted_median(np.stack(noises)[:, group], weights) for group in range(2)]
    return Tracks(
        paths=np.stack([_padded(p) for p in paths]),
        times=times,
        positions=np.concatenate(positions),
        centre=centre,
        counted=np.concatenate(kept),
        noise=(noise_of_all[0], noise_of_all[1]),
        lag=int(_weighted_median(np.asarray(lags, float), weights)),
    )


def _padded(path: np.ndarray) -> np.ndarray:
    missing = _CORE + _AFTER - len(path)
    return np.concatenate([path, np.repeat(path[-1:], missing, axis=0)]) if missing else path


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, share[-1] / 2)])


def cut_chords(tracks: Tracks, lag: int) -> Chords:
    """Compute the velocity of the chord of so many samples that starts at each pose."""
    number = len(tracks.times)
    ends = np.minimum(np.arange(number) + lag, number - 1)
    span = tracks.times[ends] - tracks.times
    chords = tracks.paths[:, lag : lag + _CORE] - tracks.paths[:, :_CORE]
    chords = chords.reshape(-1, *chords.shape[2:])[:number]
    whole = np.arange(number) + lag < number
    chords[~whole] = 0
    in_ground = chords[:, LinearType.GB]
    sizes = (
        np.linalg.norm(in_ground[:, :, 0], axis=1),
        np.linalg.norm(in_ground[:, :, 1:], axis=(1, 2)) / 2**0.5,
    )
    far = (sizes[0] > _REST * tracks.noise[0]) | (sizes[1] > _REST * tracks.noise[1])
    usable = whole & tracks.counted & tracks.counted[ends]
    moving = usable & far
    if np.sum(moving) < _MOVING * np.sum(usable):
        moving = usable
    return Chords(chords / np.where(span > 0, span, 1)[:, None, None, None], moving, span, lag)


def local_paths(tracks: Tracks, start: int, stop: int) -> np.ndarray:
    """Return the paths of some poses, (M, 4, 3, 4) m and 1 by frame type, without seams between chunks."""
    first = start // _CORE
    pieces, joined = [], None
    for chunk in range(first, (stop - 1) // _CORE + 1):
        low, high = max(start - chunk * _CORE, 0), min(stop - chunk * _CORE, _CORE)
        own = tracks.paths[chunk]
        # a chunk goes on where the one before it ended: both hold the first pose of this one
        shift = 0 if joined is None else joined - own[0]
        pieces.append(own[low:high] + shift)
        joined = own[_CORE] + shift
    return np.concatenate(pieces)
