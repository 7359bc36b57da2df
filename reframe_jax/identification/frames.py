"""The frames of an identification, and the candidates among which they won."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations

__all__ = ["AllCandidates", "AngularFrame", "Candidates", "LinearFrame", "PoseNoise", "member"]


def member(kind: type[IntEnum], code: jax.Array) -> Any:
    """The enum member of a concrete scalar; anything else as it is."""
    if isinstance(code, jax.core.Tracer) or np.ndim(code):
        return code
    return kind(int(code))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseNoise:
    """Standard deviation of the white noise in the poses, estimated from the poses.

    Attributes:
        position: (...) m, of every component of the position.
        rotation: (...) rad, of every component of the orientation.
    """

    position: jax.Array
    rotation: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AngularFrame:
    """The identified frame of the angular velocity.

    Attributes:
        type_code: (...) int, ``AngularType`` of the frame; read it as ``frame_type``.
        rotvec: (..., 3) rad, orientation of the frame in the body of its type. Constrained axes come first,
            then free ones, each sorted by ``amplitude``, ascending; the axes are right-handed, and the first
            and the third have a positive largest component.
        dof: (..., 3) int, 1 where the axis is free.
        free_probability: (..., 3) probability that the axis is free, ascending.
        rms: (..., 3) rad/s, RMS angular velocity along each axis (lambda in the paper), at the smallest time
            scale that is used.
        amplitude: (..., 3) rad, RMS displacement along each axis over the recording: how far free axes moved,
            and how far constrained axes give.
        norm: (...) rad/s, the minimised norm: the geometric mean of the RMS velocities over axes and scales.
        norms: (..., 2) rad/s, the norms of types G and B.
        tied: (..., 2) bool, types that fit equally well, this one included.
        free_rotation: (..., 3) bool, axes about which the frame can be turned without changing the
            constraint: those whose two other axes are both free or both constrained.
    """

    type_code: jax.Array
    rotvec: jax.Array
    dof: jax.Array
    free_probability: jax.Array
    rms: jax.Array
    amplitude: jax.Array
    norm: jax.Array
    norms: jax.Array
    tied: jax.Array
    free_rotation: jax.Array

    @property
    def frame_type(self) -> Any:
        """``AngularType`` of a single window; integer codes of a batch."""
        return member(AngularType, self.type_code)

    @property
    def axes(self) -> jax.Array:
        """(..., 3, 3): columns are the frame's axes."""
        return rotations.rotation_exp(self.rotvec)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LinearFrame:
    """The identified frame of the linear velocity.

    Attributes:
        type_code: (...) int, ``LinearType`` of the frame; read it as ``frame_type``.
        rotvec: (..., 3) rad, orientation of the frame in the body of the type's first letter; axes in
            the order and handedness of :class:`AngularFrame`.
        position: (..., 3) m, origin of the frame in the body of the type's second letter. Where
            ``free_position`` leaves a choice it is the point closest to the recorded motion: to the
            mean position of {b} for GG and BG, to the origin of {b} for BB and GB.
        dof: (..., 3) int, 1 where the axis is free.
        free_probability: (..., 3) as in :class:`AngularFrame`.
        rms: (..., 3) m/s, RMS velocity along each axis (lambda in the paper), at the smallest time scale that
            is used.
        amplitude: (..., 3) m, RMS displacement along each axis, as in :class:`AngularFrame`.
        norm: (...) m/s, the minimised norm, as in :class:`AngularFrame`.
        norms: (..., 4) m/s, the norms of types BB, GB, GG and BG.
        tied: (..., 4) bool, types that fit equally well, this one included.
        free_rotation: (..., 3) bool, as in :class:`AngularFrame`.
        free_position: (..., 3, 3) projector onto the directions in which the origin can be moved
            without changing the constraint (the "-" of the paper's Table 2); its trace is their number.
    """

    type_code: jax.Array
    rotvec: jax.Array
    position: jax.Array
    dof: jax.Array
    free_probability: jax.Array
    rms: jax.Array
    amplitude: jax.Array
    norm: jax.Array
    norms: jax.Array
    tied: jax.Array
    free_rotation: jax.Array
    free_position: jax.Array

    @property
    def frame_type(self) -> Any:
        """``LinearType`` of a single window; integer codes of a batch."""
        return member(LinearType, self.type_code)

    @property
    def axes(self) -> jax.Array:
        """(..., 3, 3): columns are the frame's axes."""
        return rotations.rotation_exp(self.rotvec)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Candidates:
    """Frames of all types at their lowest norm, and of the reported type; one more axis T, over the types.

    Attributes:
        rotvec: (..., T, 3) rad.
        dof: (..., T, 3) int; of types that lost, as many axes as the winner has free.
        rms: (..., T, 3) rad/s or m/s.
        norm: (..., T) rad/s or m/s.
        position: (..., T, 3) m; None for angular frames.
    """

    rotvec: jax.Array
    dof: jax.Array
    rms: jax.Array
    norm: jax.Array
    position: jax.Array | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AllCandidates:
    """Candidates of both groups.

    Attributes:
        angular: types G and B.
        linear: types BB, GB, GG and BG.
    """

    angular: Candidates
    linear: Candidates
