"""Exact likelihood of every place of a boundary, where a constraint holds to the noise.

On either side the body moves by random forces along the free axes of that side's frame and not along the
others, and every pose is measured with white noise. A Kalman filter from either side sums up the likelihood
of the poses up to the boundary. There position and velocity are the same on both sides, or the velocity
jumps, as where a tool hits a surface: both are as likely beforehand.

The forces of a hand are smoother than random ones, and gentler where it sets out or comes to rest. Poses that
follow closely therefore say less than the filters believe: a share of their evidence counts.
"""

from dataclasses import dataclass

import numpy as np

from reframe_jax.segmentation.chords import Tracks
from reframe_jax.segmentation.sides import Side, path_along_axes, path_of_sensor, paths_at, responses
from reframe_jax.segmentation.spans import Fits

__all__ = ["place_costs"]

_KNOWN = 200  # poses of a segment from which its motion is known, at least, where it has as many
_FIRST = 4  # poses after which a filter has forgotten how it began
_DIFFUSE = 1e4  # variance of what is not known at the beginning, in units of the noise and a sample
_FORCES = np.concatenate(
    [[0.0], 10.0 ** np.arange(-8, 12.1, 0.5)]
)  # spectra to choose from, in the same units
_HELD = 1e-3  # share of the spectrum of free motion below which an axis is held
_EXPLAINED = (
    0.4  # share of the evidence that counts; from simulations at 25 to 500 Hz, 10 um to 1 mm of noise
)
_LEAST = 1e-9  # m and rad: noise of poses that were computed


@dataclass(frozen=True)
class _Motion:
    """What the filters of S sides read, in units of the noise and of a sample; known poses before open ones.

    Attributes:
        path: (S, M, 6) along the axes of the frame.
        response: (S, M, 6, 6) of the path to errors of the sensor.
        sensor: (S, M, 6) path of the sensor.
        blind: (S, M) variance of the noise over the usual one: large for outliers.
        step: (S, M) time since the pose before.
        begin: (S,) index of the first known pose; those before it are padding.
        known: number of poses up to the last known one.
    """

    path: np.ndarray
    response: np.ndarray
    sensor: np.ndarray
    blind: np.ndarray
    step: np.ndarray
    begin: np.ndarray
    known: int


@dataclass(frozen=True)
class _Filtered:
    """State of the body at the last known pose and the open ones, and what these cost.

    Attributes:
        cost: (S, n) nats of each open pose, given those before it.
        level, rate: (S, n + 1, 6) before the boundary as predicted, behind it as filtered.
        covariance: (S, n + 1, 12, 12) of level and rate.
        typical: (S, 6, 6) mean square of the rate over the known poses.
    """

    cost: np.ndarray
    level: np.ndarray
    rate: np.ndarray
    covariance: np.ndarray
    typical: np.ndarray


def place_costs(tracks: Tracks, fits: Fits, pairs: list[tuple[Side, Side]]) -> list[np.ndarray | None]:
    """Compute what every place of several boundaries costs.

    Args:
        tracks: of the recording.
        fits: of the segments.
        pairs: of each boundary the sides before and behind it, with the same open poses.

    Returns:
        Of each boundary (n + 1,) nats: behind none of the n open poses, behind the first, ...; None where
        neither side holds any axis to the noise, so that this model of the motion does not apply.
    """
    if not pairs:
        return []
    sides = [before for before, _ in pairs] + [after for _, after in pairs]
    motion = _gather(tracks, fits, sides)
    forces, held = _forces(motion)
    backward = np.arange(len(sides)) >= len(pairs)
    filtered = _filter(motion, forces, backward)
    costs: list[np.ndarray | None] = []
    for i, (before, _) in enumerate(pairs):
        j, number = i + len(pairs), before.open
        if not (held[i] or held[j]):
            costs.append(None)
            continue
        ahead = np.concatenate([[0], np.cumsum(filtered.cost[i, :number])])
        back = np.concatenate([[0], np.cumsum(filtered.cost[j, :number])])[::-1]
        costs.append(_EXPLAINED * (ahead + back + _join(motion, filtered, i, j, number)))
    return costs


def _gather(tracks: Tracks, fits: Fits, sides: list[Side]) -> _Motion:
    """Paths of all sides, padded to one length."""
    inside = [min(side.stop - side.start, max(_KNOWN, 2 * side.open)) for side in sides]
    known, longest = max(inside), max(side.open for side in sides)
    noise = np.asarray(tracks.noise) + _LEAST
    unit = np.repeat([noise[1], noise[0]], 3)
    sample = float(np.median(np.diff(tracks.times)))
    number = known + longest + 1
    path, sensor = np.empty((2, len(sides), number, 6))
    response = np.empty((len(sides), number, 6, 6))
    blind, step = np.ones((2, len(sides), number))
    for i, side in enumerate(sides):
        # the pose behind the open ones belongs to the other side: what is predicted for it is compared
        poses = side.poses(inside[i])
        poses = np.append(poses, poses[-1] + (-1 if side.backward else 1)).clip(0, len(tracks.times) - 1)
        place = (np.arange(number) - (known - inside[i])).clip(0, len(poses) - 1)
        paths = paths_at(tracks, poses)
        own = path_along_axes(paths, fits, side.which)
        path[i] = ((own - own[inside[i] - 1]) / unit)[place]
        own = path_of_sensor(paths)
        sensor[i] = ((own - own[inside[i] - 1]) / unit)[place]
        response[i] = (responses(tracks, paths, poses, fits, side.which) * unit / unit[:, None])[place]
        blind[i] = np.where(tracks.counted[poses], 1, _DIFFUSE)[place]
        step[i, 1:] = np.abs(np.diff(tracks.times[poses[place]])) / sample
    return _Motion(path, response, sensor, blind, step, known - np.asarray(inside), known)


def _forces(motion: _Motion) -> tuple[np.ndarray, np.ndarray]:
    """Spectrum of the forces along every axis, (S, 6), and whether any axis of a side is held, (S,).

    Forces are as strong on both sides of a boundary: how briskly somebody moves does not tell one
    constraint from another. Held axes keep what little motion their segment shows.
    """
    square = np.sum(motion.response**2, axis=-1)
    noise = np.mean(square[:, : motion.known], axis=1)
    axes = _likelihood(motion, motion.path, noise)
    own = _FORCES[np.argmax(axes, axis=1)] * noise
    sensor = _likelihood(motion, motion.sensor, np.ones_like(noise))
    pairs = len(own) // 2
    both = (sensor[:pairs] + sensor[pairs:]).reshape(pairs, len(_FORCES), 2, 3).sum(axis=-1)
    common = np.tile(np.repeat(_FORCES[np.argmax(both, axis=1)], 3, axis=1), (2, 1))
    spread = np.mean(motion.response[:, : motion.known] ** 2 @ common[:, None, :, None], axis=1)[..., 0]
    held = own <= _HELD * spread
    return np.where(held, own, spread), np.any(held, axis=1)


def _likelihood(motion: _Motion, path: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Log-likelihood (S, F, 6) of the known poses by spectrum, every axis by itself, with noise (S, 6)."""
    noise = noise[:, None]
    force = _FORCES[:, None] * noise
    shape = (len(path), len(_FORCES), 6)
    total, level, rate, a, b, c = np.zeros((6, *shape))
    for k in range(motion.known):
        new = (motion.begin == k)[:, None, None]
        t = motion.step[:, k, None, None]
        level = np.where(new, path[:, None, k], level + t * rate)
        rate = np.where(new, 0, rate)
        a = np.where(new, _DIFFUSE * noise, a + t * (2 * b + t * c) + force * t**3 / 3)
        b = np.where(new, 0, b + t * c + force * t**2 / 2)
        c = np.where(new, _DIFFUSE * noise, c + force * t)
        variance = a + noise * motion.blind[:, k, None, None]
        error = path[:, None, k] - level
        counts = (k >= motion.begin + _FIRST)[:, None, None]
        total -= counts * (error**2 / variance + np.log(variance)) / 2
        gain, follow = a / variance, b / variance
        level, rate = level + gain * error, rate + follow * error
        a, b, c = a - gain * a, b - gain * b, c - follow * b
    return total


def _filter(motion: _Motion, force: np.ndarray, backward: np.ndarray) -> _Filtered:
    """Kalman filter of all axes together, with spectra (S, 6); sides behind the boundary run backward."""
    sides, number = motion.path.shape[:2]
    start = _DIFFUSE * np.eye(6) * np.mean(motion.response[:, :1] ** 2 @ np.ones((6, 1)), axis=1)
    spectrum = np.eye(6) * force[:, None]
    level, rate, a, b, c = (np.zeros((sides, *shape)) for shape in ((6,), (6,), (6, 6), (6, 6), (6, 6)))
    cost, levels, rates, covariances = [], [], [], []
    squares, count = np.zeros((sides, 6, 6)), np.zeros((sides, 1, 1))
    for k in range(number):
        new = motion.begin == k
        t = motion.step[:, k, None, None]
        a = a + t * (b + b.swapaxes(1, 2) + t * c) + spectrum * t**3 / 3
        b = b + t * c + spectrum * t**2 / 2
        c = c + spectrum * t
        level = level + t[..., 0] * rate
        level[new], rate[new] = motion.path[new, k], 0
        a[new], b[new], c[new] = start[new], 0, start[new]
        predicted = level, rate, a, b, c
        response = motion.response[:, k]
        variance = a + response @ response.swapaxes(1, 2) * motion.blind[:, k, None, None]
        error = (motion.path[:, k] - level)[..., None]
        solved = np.linalg.solve(variance, np.concatenate([a, b, error], axis=2))
        gain, follow, weight = solved[..., :6], solved[..., 6:12], solved[..., 12:]
        if k >= motion.known:
            size = np.linalg.slogdet(variance)[1]
            cost.append((np.sum(error * weight, axis=(1, 2)) + size) / 2)
        back = a.swapaxes(1, 2), b.swapaxes(1, 2)
        level, rate = level + (back[0] @ weight)[..., 0], rate + (back[1] @ weight)[..., 0]
        a, b, c = _symmetric(a - back[0] @ gain), b - back[0] @ follow, _symmetric(c - back[1] @ follow)
        settled = (k >= motion.begin + _FIRST)[:, None, None] & (k < motion.known)
        squares, count = squares + settled * rate[:, :, None] * rate[:, None], count + settled
        if k >= motion.known - 1:
            kept = [
                np.where(backward.reshape(-1, *[1] * (x.ndim - 1)), x, y)
                for x, y in zip((level, rate, a, b, c), predicted, strict=True)
            ]
            levels.append(kept[0])
            rates.append(kept[1])
            covariances.append(np.block([[kept[2], kept[3]], [kept[3].swapaxes(1, 2), kept[4]]]))
    # time runs backward behind the boundary, and so do rates there
    sign = np.where(backward, -1, 1)
    flip = np.concatenate([np.ones((sides, 6)), np.repeat(sign[:, None], 6, axis=1)], axis=1)[:, None]
    return _Filtered(
        cost=np.stack(cost, axis=1) if cost else np.zeros((sides, 0)),
        level=np.stack(levels, axis=1),
        rate=np.stack(rates, axis=1) * sign[:, None, None],
        covariance=np.stack(covariances, axis=1) * flip[..., None] * flip[:, :, None],
        typical=squares / np.maximum(count, 1),
    )


def _symmetric(matrices: np.ndarray) -> np.ndarray:
    """Without what rounding has left; it would grow."""
    return (matrices + matrices.swapaxes(1, 2)) / 2


def _join(motion: _Motion, filtered: _Filtered, i: int, j: int, number: int) -> np.ndarray:
    """Cost of the states of sides i and j differing at each place of their boundary, (number + 1,)."""
    states, covariances, jumps = [], [], []
    for side, first in ((i, 1), (j, 0)):
        # before the boundary predicted for the first pose behind it, behind it filtered with this pose
        places = np.arange(number + 1) + first if side == i else np.arange(number, -1, -1)
        index = motion.known - 1 + places
        back = np.linalg.inv(motion.response[side, index])
        both = np.zeros((number + 1, 12, 12))
        both[:, :6, :6] = both[:, 6:, 6:] = back
        state = np.concatenate(
            [filtered.level[side, places] - motion.path[side, index], filtered.rate[side, places]], axis=1
        )
        states.append((both @ state[..., None])[..., 0])
        covariances.append(both @ filtered.covariance[side, places] @ both.swapaxes(1, 2))
        jumps.append(back @ filtered.typical[side] @ back.swapaxes(1, 2))
    apart, steady = states[0] - states[1], covariances[0] + covariances[1]
    sudden = steady.copy()
    sudden[:, 6:, 6:] += jumps[0] + jumps[1]
    costs = []
    for covariance in (steady, sudden):
        square = np.sum(apart * np.linalg.solve(covariance, apart[..., None])[..., 0], axis=1)
        costs.append((square + np.linalg.slogdet(covariance)[1]) / 2)
    return -np.logaddexp(-costs[0], -costs[1])
