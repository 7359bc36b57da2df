"""The two sides of a boundary: paths along the axes of each segment's frame, and what errors do to them."""

from dataclasses import dataclass

import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.segmentation.chords import Tracks, local_paths
from reframe_jax.segmentation.spans import Fits

__all__ = ["Side", "path_along_axes", "path_of_sensor", "paths_at", "responses"]


@dataclass(frozen=True)
class Side:
    """One side of a boundary.

    Attributes:
        which: number of the segment's fit.
        start, stop: poses [start, stop) known to be in the segment.
        end: the poses between the known ones and this index may belong to either segment.
        backward: whether the segment comes after the boundary.
    """

    which: int
    start: int
    stop: int
    end: int
    backward: bool

    @property
    def open(self) -> int:
        """Number of poses that may belong to either segment."""
        return abs(self.end - (self.start if self.backward else self.stop))

    def poses(self, inside: int) -> np.ndarray:
        """Indices of the last known poses, then of the open ones: away from the segment's middle."""
        if self.backward:
            return np.arange(self.start + inside - 1, self.end - 1, -1)
        return np.arange(self.stop - inside, self.end)


def path_along_axes(paths: np.ndarray, fits: Fits, which: int) -> np.ndarray:
    """Path along the axes of a fitted frame, (M, 6): rad of the angular axes, then m of the linear ones.

    Args:
        paths: (M, 4, 3, 4), as :func:`reframe_jax.segmentation.chords.local_paths` returns them.
        fits: of the segments.
        which: number of the fit.
    """
    kind = LinearType(int(fits.linear_type[which]))
    x = paths[:, kind, :, 0] + paths[:, kind, :, 1:] @ fits.position[which]
    turned = LinearType.GG if fits.angular_type[which] == AngularType.G else LinearType.BB
    return np.concatenate(
        [_turns(paths, turned) @ fits.angular_axes[which], x @ fits.linear_axes[which]], axis=1
    )


def path_of_sensor(paths: np.ndarray) -> np.ndarray:
    """Path of {b} itself along the axes of the ground, (M, 6): rad, then m."""
    return np.concatenate([_turns(paths, LinearType.GG), paths[:, LinearType.GB, :, 0]], axis=1)


def responses(tracks: Tracks, paths: np.ndarray, poses: np.ndarray, fits: Fits, which: int) -> np.ndarray:
    """How the path along the axes of a fitted frame changes with the measured pose.

    Args:
        tracks: of the recording.
        paths: (M, 4, 3, 4) of these poses.
        poses: (M,) their indices.
        fits: of the segments.
        which: number of the fit.

    Returns:
        (M, 6, 6), from a small turn (rad) and shift (m) of {b} in the ground to rad and m along the axes.
    """
    kind = LinearType(int(fits.linear_type[which]))
    rotation = paths[:, LinearType.GB, :, 1:]
    position = fits.position[which]
    on_body = kind in (LinearType.GB, LinearType.BB)
    arm = rotation @ position if on_body else position - tracks.positions[poses]
    back = np.swapaxes(rotation, 1, 2)
    straight = np.broadcast_to(np.eye(3), rotation.shape)
    turning = fits.angular_axes[which].T @ (straight if fits.angular_type[which] == AngularType.G else back)
    sliding = fits.linear_axes[which].T @ (straight if kind in (LinearType.GG, LinearType.GB) else back)
    found = np.zeros((len(poses), 6, 6))
    found[:, :3, :3], found[:, 3:, 3:] = turning, sliding
    found[:, 3:, :3] = sliding @ np.cross(np.eye(3), arm[:, None]).swapaxes(1, 2)
    return found


def _turns(paths: np.ndarray, kind: LinearType) -> np.ndarray:
    turned = paths[:, kind]
    return np.stack([turned[:, 2, 2], turned[:, 0, 3], turned[:, 1, 1]], axis=-1)


def paths_at(tracks: Tracks, poses: np.ndarray) -> np.ndarray:
    """Paths (M, 4, 3, 4) of neighbouring poses, by their indices, without seams."""
    first = int(poses.min())
    return local_paths(tracks, first, int(poses.max()) + 1)[poses - first]
