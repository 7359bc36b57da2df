"""A recording in cells: mean poses of a fraction of the time in which the motion becomes independent."""

from dataclasses import dataclass
from math import comb

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.segmentation.constants import SEGMENTS as C

__all__ = ["GROUND_TYPES", "Cells", "make_cells", "path_features"]

GROUND_TYPES = [2, 3]  # GG and BG: origins in the ground

_CHUNK = 20_000  # poses whose features are computed at once
_FEWEST = 6  # independent values that a recording has at least
_LEAST_TURN = 3  # of the motion, over a rotation that counts as free
_PAIRS = 4000  # pairs of poses from which a structure function is estimated


@dataclass(frozen=True)
class Cells:
    """The cells of a recording and the sizes that belong to it.

    Attributes:
        linear: (4, N, 12) features of the linear types BB, GB, GG, BG: the path of an origin x along n is the
            product of the feature with n (1, x), row by row.
        angular: (2, N, 3) rotation that has been summed up in the ground and in the body, rad.
        samples: poses in a cell.
        duration: s, of a cell.
        motion_time: s, in which the motion gives one independent value.
        motion: (2,) m and rad, amplitudes of a coordinate and of a rotation.
        floor: (2,) m and rad, below which residuals are not distinguished from zero.
        chance: (L,) log lengths of spans in cells, and (L, 3) log m, sizes of 1, 2 and 3 rows that are fitted
            where nothing is held; None before they are known.
        progress: (N + 1,) cells in which the usual motion would have come as far as the motion up to each;
            None before it is known.
    """

    linear: np.ndarray
    angular: np.ndarray
    samples: int
    duration: float
    motion_time: float
    motion: tuple[float, float]
    floor: tuple[float, float]
    chance: tuple[np.ndarray, np.ndarray] | None = None
    progress: np.ndarray | None = None

    def references(self, spans: np.ndarray) -> np.ndarray:
        """Amplitudes (P, 3), m, of free translations where 1, 2 and 3 rows are fitted to spans (P, 2)."""
        if self.chance is None or self.progress is None:
            return np.full((len(spans), 3), self.reference[0])
        lengths = np.maximum(self.progress[spans[:, 1]] - self.progress[spans[:, 0]], 1)
        logs = [np.interp(np.log(lengths), self.chance[0], size) for size in self.chance[1].T]
        return np.minimum(np.exp(logs).T, self.reference[0])

    @property
    def weight(self) -> float:
        """Independent values in a cell."""
        return self.duration / self.motion_time

    @property
    def reference(self) -> tuple[float, float]:
        """Amplitude of a free coordinate, m and rad."""
        return self.motion[0] * C.reference, self.motion[1] * C.reference

    def bound(self, part: float) -> tuple[float, float]:
        """Most that a coordinate moves, m and rad: a part of the motion of the recording, or its noise."""
        a, b = (max(part * motion, 3 * floor) for motion, floor in zip(self.motion, self.floor, strict=True))
        return a, b


def make_cells(rotation: np.ndarray, position: np.ndarray, step: float) -> Cells:
    """Cells of poses (P, 3, 3) and (P, 3) m, ``step`` seconds apart."""
    noise = _white_noise(position), _white_noise(np.cumsum(_turns(rotation), axis=0))
    time, motion, turn = _motion_scale(rotation, position, noise, step)
    samples = max(1, min(round(time / C.cells / step), len(position) // 8))
    linear, angular = _average_features(rotation, position, samples)
    floor = (C.floor_position, C.floor_rotation)
    floors = [float(np.hypot(a, b / np.sqrt(samples))) for a, b in zip(floor, noise, strict=True)]
    return Cells(linear, angular, samples, samples * step, time, (motion, turn), (floors[0], floors[1]))


def _average_features(
    rotation: np.ndarray, position: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Means of the features over cells of so many poses; a last cell that is not full is left out."""
    number = len(position) // samples
    linear, angular = np.empty((4, number, 12)), np.empty((2, number, 3))
    # paths that have been summed up go on where the last chunk ended; poses have nothing to go on from
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
    """Features of the linear types (4, N, 12) and of the angular types (2, N, 3) of poses."""
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
    start = np.zeros((1, 3))
    angular = [np.concatenate([start, np.cumsum(each, axis=0)]) for each in (turn_ground, turn)]
    return np.stack([each.reshape(-1, 12) for each in linear]), np.stack(angular)


def _turns(rotation: np.ndarray) -> np.ndarray:
    """Rotations (P - 1, 3) in the body from each of P poses to the next, rad."""
    between = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    cosine = (np.einsum("kii->k", between) - 1) / 2
    if np.any(cosine < -0.9):  # near half turns the skew part does not determine the axis
        return rotation_vectors(between)
    skew = (between - np.swapaxes(between, 1, 2))[:, [2, 0, 1], [1, 2, 0]] / 2
    sine = np.sqrt(np.sum(skew**2, axis=1))
    return np.where(sine > 0, np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1), 1)[:, None] * skew


def _white_noise(path: np.ndarray) -> float:
    """White noise of each component of a path (P, 3): the least that differences of several orders show."""
    found = []
    for order in (2, 3, 4, 6):
        if len(path) >= order + 8:
            square = np.sum(np.diff(path, order, axis=0) ** 2, axis=1)
            found.append(np.sqrt(np.median(square) / 2.366 / comb(2 * order, order)))
    return float(min(found))


def _motion_scale(
    rotation: np.ndarray, position: np.ndarray, noise: tuple[float, float], step: float
) -> tuple[float, float, float]:
    """Time in which the motion gives an independent value, s, and its amplitudes, m and rad."""
    number = len(position)
    lags = np.unique(np.round(2 ** np.arange(0, np.log2(max(2, number / 3)), 0.5)).astype(int))
    scale = np.array([1, C.lever])
    still = 6 * float(np.sum(np.square(scale * noise)))

    def displacements(lag: int) -> np.ndarray:
        """Squares of translations and rotations, (pairs, 2) m^2."""
        first = np.unique(np.linspace(0, number - 1 - lag, _PAIRS).astype(int))
        chord = np.sum((rotation[first + lag] - rotation[first]) ** 2, axis=(1, 2)) / 8
        turn = 2 * np.arcsin(np.clip(np.sqrt(chord), 0, 1))
        shift = np.linalg.norm(position[first + lag] - position[first], axis=1)
        return np.square(scale * np.stack([shift, turn], axis=1))

    def size(lag: int) -> float:
        """Mean displacement; where the body is still, it adds nothing at any lag."""
        return float(np.mean(np.sqrt(np.maximum(displacements(lag).sum(axis=1) - 4 * still, 0))))

    sizes = np.array([size(lag) for lag in lags])
    time = max(step, number * step / _FEWEST)
    if sizes.max() > 0:
        speed = sizes / lags
        fastest = int(np.argmax(speed))
        slow = np.flatnonzero(speed[fastest:] < speed[fastest] / 2)
        lag = lags[fastest + slow[0]] if len(slow) else lags[-1]
        time = float(np.clip(C.motion_time * lag * step, step, time))
    # displacements of independent poses have twice the variance
    square = displacements(max(1, min(round(2 * time / step), number - 2)))
    motion = max(float(np.sqrt(np.quantile(square.sum(axis=1), 0.8) / 6)), 1e-6)
    turn = float(np.sqrt(np.quantile(square[:, 1], 0.8) / 6))
    return time, motion, max(turn, motion / _LEAST_TURN) / C.lever
