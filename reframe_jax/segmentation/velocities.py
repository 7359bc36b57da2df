"""Velocities of a segmented recording along the axes of each segment's own frames."""

import jax
import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.identification.results import Identification
from reframe_jax.segmentation.chords import cut_chords, track_poses
from reframe_jax.segmentation.results import Segmentation

__all__ = ["segment_velocities"]


def segment_velocities(poses: np.ndarray, found: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    """Compute the velocities along the axes of the frames that hold at each time.

    Args:
        poses: (N, 4, 4), those that were segmented; m.
        found: their segmentation.

    Returns:
        Angular velocities, (N, 3) rad/s, and linear velocities of the frame's origin, (N, 3) m/s, by the
        first pose of each chord of ``found.lag`` samples. NaN where a chord crosses a boundary or ends beyond
        the recording, and in segments without identification.
    """
    with jax.enable_x64(True):
        tracks = track_poses(np.asarray(poses, float), found.times)
    maps = cut_chords(tracks, found.lag).maps
    angular, linear = (np.full((len(maps), 3), np.nan) for _ in range(2))
    for segment in found.segments:
        if segment.identification is not None:
            own = slice(segment.start, max(segment.stop - found.lag, segment.start))
            angular[own], linear[own] = _along(maps[own], segment.identification, tracks.centre)
    return angular, linear


def _along(maps: np.ndarray, found: Identification, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities along the axes of one identification, about whose ground origin the maps are not."""
    kind = LinearType(int(found.linear.type_code))
    position = np.asarray(found.linear.position)
    if kind in (LinearType.GG, LinearType.BG):
        position = position - centre
    turned = maps[:, LinearType.GG if int(found.angular.type_code) == AngularType.G else LinearType.BB]
    rates = np.stack([turned[:, 2, 2], turned[:, 0, 3], turned[:, 1, 1]], axis=-1)
    velocities = maps[:, kind, :, 0] + maps[:, kind, :, 1:] @ position
    return rates @ np.asarray(found.angular.axes), velocities @ np.asarray(found.linear.axes)
