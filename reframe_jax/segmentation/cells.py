"""Cells: mean features of short parts of a recording, all with the same number of poses.

Features are numbers computed from a pose, such that every coordinate in every frame is a weighted sum of
them. A cell is a fraction of the motion time: the time after which displacements are decorrelated.
"""

from dataclasses import dataclass
from math import comb

import numpy as np

from reframe_jax.geometry.numpy_rotations import angles_between, rotation_vectors
from reframe_jax.identification.preparation import REACH
from reframe_jax.tuning import EVIDENCE
from reframe_jax.tuning import SEGMENTS as C

_CHUNK = 20_000  # poses per chunk, which bounds the memory
_FEWEST = 6  # smallest number of independent values in a recording
_LEAST_TURN = 3  # largest ratio of the motion to the reference motion of rotations
_SAMPLES = 4000  # pairs of poses in one value of the structure function


@dataclass(frozen=True)
class Cells:
    """Cells of a recording, and the sizes of its motion and noise."""

    rotation: np.ndarray  # (P, 3, 3) rotations of the body at all poses
    position: np.ndarray  # (P, 3) m, path of the point of the body that moves least, about its mean
    reach: float  # m, half the width of the cube in which origins are searched, about that of each body
    # (4, N, 12) features of the linear types BB, GB, GG, BG. The coordinate of an origin x along a direction
    # n is the scalar product of a feature with the matrix n (1, x), row by row
    linear: np.ndarray
    angular: np.ndarray  # (2, N, 3) rad, integral of the angular velocity in the ground and in the body
    samples: int  # number of poses per cell
    weight: float  # number of independent values per cell
    motion_time: float  # s, time in which the motion gives one independent value
    motion: np.ndarray  # (2,) m and rad, amplitudes of a translation and of a rotation
    floor: np.ndarray  # (2,) m and rad, residuals below this size count as zero
    price: float  # log evidence that a segment costs
    progress: np.ndarray  # (N + 1,) number of cells of usual motion that equals the motion before each cell
    # (L,) logarithms of span lengths in cells, and (L, 4, 4) sums of the logarithms of the sizes in m and rad
    # of 0 to 3 translations and 0 to 3 rotations, fitted to motion without any held coordinate; empty before
    # :func:`with_chance`
    chance: tuple[np.ndarray, ...] = ()

    def references(self, spans: np.ndarray) -> np.ndarray:
        """Sums (P, 4, 4) of log amplitudes of 0 to 3 free translations and rotations in spans (P, 2)."""
        a, b = np.log(self.reference)
        at = np.log(np.maximum(self.progress[spans[:, 1]] - self.progress[spans[:, 0]], 1))
        lengths, sums = self.chance
        logs = np.stack([np.interp(at, lengths, each) for each in sums.reshape(-1, 16).T], axis=1)
        return np.minimum(logs.reshape(-1, 4, 4), np.arange(4)[:, None] * a + np.arange(4) * b)

    @property
    def reference(self) -> np.ndarray:
        """(2,) m and rad, amplitudes of a free coordinate in a long span: a fraction of the motion."""
        return self.motion * C.reference

    def bound(self, part: float) -> np.ndarray:
        """Largest RMS (2,) of a held coordinate, m and rad: a part of the motion, or three floors if more."""
        return np.maximum(part * self.motion, 3 * self.floor)


def make_cells(poses: np.ndarray, step: float) -> Cells:
    """Divide poses (N, 4, 4), with a time step in s, into :class:`Cells`, still without chance."""
    rotation, (position, distance) = poses[:, :3, :3], _least_moving_point(poses)
    reach = REACH * max(1.0, float(np.linalg.norm(position, axis=1).max()))
    noise = np.array([_white_noise(position), _white_noise(np.cumsum(_turns(rotation), axis=0))])
    time, motion = _motion_scale(rotation, position, noise, step)
    samples = max(1, min(round(time / C.cells / step), len(position) // 8))
    linear, angular = _average_features(rotation, position, samples)
    errors = np.hypot(C.floor_position, C.floor_rotation * distance), C.floor_rotation
    floor = np.hypot(errors, noise / np.sqrt(samples))
    number = linear.shape[1]
    sizes = samples, samples * step / time, time, motion, floor, C.price + float(np.log(number))
    return Cells(rotation, position, reach, linear, angular, *sizes, np.arange(number + 1.0))


def _least_moving_point(poses: np.ndarray) -> tuple[np.ndarray, float]:
    """Find the point of the body that moves least: its path (N, 3), m, about its mean, and its distance, m.

    With this point as the origin of the body, segments hardly depend on the choice of the body frame.
    """
    rotation, position = (each - each.mean(axis=0) for each in (poses[:, :3, :3], poses[:, :3, 3]))
    square = np.einsum("kia,kib->ab", rotation, rotation) + len(poses) * C.turned**2 * np.eye(3)
    point = -np.linalg.solve(square, np.einsum("kia,ki->a", rotation, position))
    return position + rotation @ point, float(np.linalg.norm(point))


def _average_features(
    rotation: np.ndarray, position: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean features of cells with ``samples`` poses; poses after the last full cell are left out."""
    number = len(position) // samples
    linear, angular = np.empty((4, number, 12)), np.empty((2, number, 3))
    # integrated paths continue at the end of the previous chunk; features of poses need no offset
    summed = np.array([[[1.0]], [[0.0]], [[1.0]], [[0.0]]]), np.ones((2, 1, 1))
    ends = [np.zeros((4, 1, 12)), np.zeros((2, 1, 3))]
    chunk = max(1, _CHUNK // samples)
    for start in range(0, number, chunk):
        stop = min(number, start + chunk)
        own = slice(start * samples, stop * samples + 1)
        parts = path_features(rotation[own], position[own])
        for k, (mean, part) in enumerate(zip((linear, angular), parts, strict=True)):
            part = part + summed[k] * ends[k]
            inner = part[:, : (stop - start) * samples]
            mean[:, start:stop] = inner.reshape(len(part), -1, samples, part.shape[2]).mean(axis=2)
            ends[k] = part[:, -1:]
    return linear, angular


def path_features(rotation: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the features (4, P, 12) and (2, P, 3) of poses, as in :class:`Cells`, before the mean."""
    back = np.swapaxes(rotation, 1, 2)
    turn = _turns(rotation)
    hat = -np.cross(turn[:, None], np.eye(3))
    angle = np.maximum(np.linalg.norm(turn, axis=1), 1e-6)[:, None, None]
    series = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    series = np.where(angle < 1e-3, 1 / 12, series)
    inverse = np.eye(3) - hat / 2 + series * hat @ hat
    chord = np.einsum("kji,kj->ki", rotation[:-1], np.diff(position, axis=0))
    shift = np.einsum("kij,kj->ki", inverse, chord)
    turn_ground = np.einsum("kij,kj->ki", rotation[:-1], turn)
    shift_ground = np.einsum("kij,kj->ki", rotation[:-1], shift) - np.cross(turn_ground, position[:-1])

    def path(shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
        each = np.concatenate([shift[:, :, None], -np.cross(turn[:, None], np.eye(3))], axis=2)
        return np.concatenate([np.zeros((1, 3, 4)), np.cumsum(each, axis=0)])

    in_ground = np.concatenate([position[:, :, None], rotation], axis=2)
    in_body = np.concatenate([-(back @ position[:, :, None]), back], axis=2)
    linear = path(shift, turn), in_ground, path(shift_ground, turn_ground), in_body
    angular = [np.concatenate([np.zeros((1, 3)), np.cumsum(each, axis=0)]) for each in (turn_ground, turn)]
    return np.stack([each.reshape(-1, 12) for each in linear]), np.stack(angular)


def _turns(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (P - 1, 3), rad, in the body, from each of P poses to the next."""
    between = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    cosine = (np.einsum("kii->k", between) - 1) / 2
    if np.any(cosine < -0.9):  # near half turns the skew part does not determine the axis
        return rotation_vectors(between)
    skew = (between - np.swapaxes(between, 1, 2))[:, [2, 0, 1], [1, 2, 0]] / 2
    sine = np.sqrt(np.sum(skew**2, axis=1))
    return np.where(sine > 0, np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1), 1)[:, None] * skew


def _white_noise(path: np.ndarray) -> float:
    """White noise of a component of paths (P, 3): the least estimate from differences of several orders."""
    found = []
    for order in (2, 3, 4, 6):
        if len(path) >= order + 8:
            square = np.sum(np.diff(path, order, axis=0) ** 2, axis=1)
            found.append(np.sqrt(np.median(square) / 2.366 / comb(2 * order, order)))
    return float(min(found))


def _motion_scale(
    rotation: np.ndarray, position: np.ndarray, noise: np.ndarray, step: float
) -> tuple[float, np.ndarray]:
    """Correlation time, s; sizes (2,) of the motion (translation and lever times rotation) and rotation."""
    number = len(position)
    lags = np.unique(np.round(2 ** np.arange(0, np.log2(max(2, number / 3)), 0.5)).astype(int))
    scale = np.array([1, EVIDENCE.lever])
    still = 6 * float(np.sum(np.square(scale * noise)))

    def displacements(lag: int) -> np.ndarray:
        """Squared translations and rotations, (pairs, 2) m^2; the lever converts rotations."""
        first = np.unique(np.linspace(0, number - 1 - lag, _SAMPLES).astype(int))
        turn = angles_between(rotation[first], rotation[first + lag])
        shift = np.linalg.norm(position[first + lag] - position[first], axis=1)
        return np.square(scale * np.stack([shift, turn], axis=1))

    def size(lag: int) -> float:
        """Mean displacement, m, without the noise: a still body contributes zero at every lag."""
        return float(np.mean(np.sqrt(np.maximum(displacements(lag).sum(axis=1) - 4 * still, 0))))

    sizes = np.array([size(lag) for lag in lags])
    time = max(step, number * step / _FEWEST)
    if sizes.max() > 0:
        speed = sizes / lags
        fastest = int(np.argmax(speed))
        slow = np.flatnonzero(speed[fastest:] < speed[fastest] / 2)
        lag = lags[fastest + slow[0]] if len(slow) else lags[-1]
        time = float(np.clip(lag / 2 * step, step, time))  # 1 / (2 B) for motion of bandwidth B
    # a displacement between independent poses has twice the variance of a pose
    square = displacements(max(1, min(round(2 * time / step), number - 2)))
    motion = max(float(np.sqrt(np.quantile(square.sum(axis=1), 0.8) / 6)), 1e-6)
    turn = float(np.sqrt(np.quantile(square[:, 1], 0.8) / 6))
    return time, np.array([motion, max(turn, motion / _LEAST_TURN) / EVIDENCE.lever])
