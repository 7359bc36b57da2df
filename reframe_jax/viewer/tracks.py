"""Data of the page for a window: the frame at every pose, and the velocities along its axes."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import locate_on_host
from reframe_jax.constraints.types import AngularType
from reframe_jax.export.table import to_table
from reframe_jax.identification.results import Identification, check_single
from reframe_jax.identification.velocities import frame_velocities


@dataclass(frozen=True, eq=False)
class FrameTrack:
    """A constraint frame at every pose of a window, in the axes of the ground.

    Attributes:
        origins: (K+1, 3) m, origins of the linear frame.
        in_body: (3,) m, origin of the linear frame in the body; None if it is fixed in the ground.
        linear_axes: (K+1, 3, 3), columns are axes.
        angular_axes: (K+1, 3, 3), columns are axes.
        linear_free, angular_free: (3,) bool, whether each axis is free.
        spread: (3, 3) m, square root of the covariance of the origin, in the body that the origin is fixed
            in; None if unknown.
        velocities: (K, 6) rad/s along the angular axes, then m/s along the linear axes; NaN where undefined.
    """

    origins: np.ndarray
    in_body: np.ndarray | None
    linear_axes: np.ndarray
    angular_axes: np.ndarray
    linear_free: np.ndarray
    angular_free: np.ndarray
    spread: np.ndarray | None
    velocities: np.ndarray


@dataclass(frozen=True, eq=False)
class WindowTrack:
    """One window of a recording.

    Attributes:
        name: name of the constraint, or the reason why there is no result.
        text: the table of the result.
        times, poses: (K+1,) s and (K+1, 4, 4) m.
        counted: (K+1,) bool, False for outliers.
        frame: the constraint frame; None for a window without a result.
        velocity_times: (K,) s, times of ``frame.velocities``.
    """

    name: str
    text: str
    times: np.ndarray
    poses: np.ndarray
    counted: np.ndarray
    frame: FrameTrack | None
    velocity_times: np.ndarray


def track_window(
    poses: "ArrayLike", times: "ArrayLike", found: Identification, *, covariance: "ArrayLike | None" = None
) -> WindowTrack:
    """Compute the data of the page for a window of poses (K+1, 4, 4), m, at times (K+1,), s.

    The covariance (3, 3), m^2, of the linear frame's origin, in the body that the origin is fixed in, is
    drawn as an ellipsoid; by default, no ellipsoid is drawn. A ValueError is raised for a batch, poses that
    were not identified, or a matrix that is not a covariance.
    """
    check_single(found)
    host = jax.device_get(found)
    places, instants = np.asarray(poses, float), np.asarray(times, float)
    if places.shape != (*host.counted.shape, 4, 4) or instants.shape != host.counted.shape:
        raise ValueError(
            f"Expected the {len(host.counted)} identified poses and their times, not "
            f"{places.shape} and {instants.shape}."
        )
    spread = None if covariance is None else _square_root(np.asarray(covariance, float))
    counted = np.asarray(host.counted, bool)
    if host.status.failed:
        return WindowTrack(host.name, host.name, instants, places, counted, None, instants[:0])
    along = frame_velocities(jnp.asarray(places), jnp.asarray(np.diff(instants)), found)
    middle = (instants[1:] + instants[:-1]) / 2
    located = locate_on_host(host.constraint_frame, places)
    on_body = host.linear.frame_type.position_body == AngularType.B
    frame = FrameTrack(
        origins=places[:, :3, 3] + located.lever,
        in_body=np.asarray(host.linear.position, float) if on_body else None,
        linear_axes=np.asarray(located.linear_axes),
        angular_axes=np.asarray(located.angular_axes),
        linear_free=np.asarray(host.linear.dof, bool),
        angular_free=np.asarray(host.angular.dof, bool),
        spread=spread,
        velocities=np.concatenate(jax.device_get(along), axis=-1),
    )
    return WindowTrack(host.name, to_table(found), instants, places, counted, frame, middle)


def _square_root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric square root of a covariance (3, 3)."""
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise ValueError(f"Expected a finite covariance of shape (3, 3), not one of {covariance.shape}.")
    values, vectors = np.linalg.eigh(covariance)
    if not np.allclose(covariance, covariance.T) or values[0] < -1e-9 * abs(values[2]):
        raise ValueError("Expected a covariance that is symmetric, without negative eigenvalues.")
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
