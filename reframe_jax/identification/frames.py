"""The frames of an identification, and the candidate frames of every type."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations


def member(kind: type[IntEnum], code: jax.Array) -> Any:
    """Return the enum member of a single code; return tracers and arrays of codes unchanged."""
    if isinstance(code, jax.core.Tracer) or np.ndim(code):
        return code
    return kind(int(code))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseNoise:
    """Standard deviation of the white noise in the poses, estimated from the poses."""

    position: jax.Array  # (...) m, of every component of the position
    rotation: jax.Array  # (...) rad, of every component of the orientation


@dataclass(frozen=True)
class _Axes:
    """Fields that angular and linear frames have in common."""

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
    def axes(self) -> jax.Array:
        """(..., 3, 3): columns are the frame's axes."""
        return rotations.rotation_exp(self.rotvec)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AngularFrame(_Axes):
    """The identified angular frame: the axes of free and constrained rotations.

    Attributes:
        type_code: (...) int, ``AngularType`` of the frame; read it as ``frame_type``.
        rotvec: (..., 3) rad, orientation of the frame in the body of its type. Constrained axes come first,
            then free axes, both in ascending order of ``amplitude``. The axes are right-handed; the largest
            component of the first and of the third axis is positive.
        dof: (..., 3) int, 1 for free axes, 0 for constrained axes.
        free_probability: (..., 3) probability that the axis is free, in ascending order.
        rms: (..., 3) rad/s, RMS angular velocity about each axis (lambda in the paper), at the smallest time
            scale that is used.
        amplitude: (..., 3) rad, RMS rotation about each axis, from its mean and without white noise.
        norm: (...) rad/s, the minimized norm: the geometric mean of the RMS velocities over axes and scales.
        norms: (..., 2) rad/s, the norms of types G and B.
        tied: (..., 2) bool, types that fit equally well, including the reported type.
        free_rotation: (..., 3) bool, axes about which the frame can be turned without changing the
            constraint: axes whose two other axes are both free or both constrained.
    """

    @property
    def frame_type(self) -> Any:
        """``AngularType`` of a single window; integer codes of a batch."""
        return member(AngularType, self.type_code)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LinearFrame(_Axes):
    """The identified linear frame: the origin, and the axes of its free and constrained translations.

    Attributes:
        type_code: (...) int, ``LinearType`` of the frame; read it as ``frame_type``.
        rotvec: (..., 3) rad, orientation of the frame in the body of the type's first letter. The order and
            the signs of the axes are those of :class:`AngularFrame`.
        position: (..., 3) m, origin of the frame in the body of the type's second letter. If several
            positions are equally valid (``free_position``), this is the position closest to the mean position
            of {b} for GG and BG, and closest to the origin of {b} for BB and GB.
        dof: (..., 3) int, 1 for free axes, 0 for constrained axes.
        free_probability: (..., 3) as in :class:`AngularFrame`.
        rms: (..., 3) m/s, RMS velocity along each axis (lambda in the paper), at the smallest time scale that
            is used.
        amplitude: (..., 3) m, RMS displacement along each axis, as in :class:`AngularFrame`.
        norm: (...) m/s, the minimized norm, as in :class:`AngularFrame`.
        norms: (..., 4) m/s, the norms of types BB, GB, GG and BG.
        tied: (..., 4) bool, types that fit equally well, including the reported type.
        free_rotation: (..., 3) bool, as in :class:`AngularFrame`.
        free_position: (..., 3, 3) projector onto the directions along which the origin can be shifted without
            changing the constraint (the "-" of the paper's Table 2). Its trace is the number of directions.
    """

    position: jax.Array
    free_position: jax.Array

    @property
    def frame_type(self) -> Any:
        """``LinearType`` of a single window; integer codes of a batch."""
        return member(LinearType, self.type_code)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Candidates:
    """The best frame of every type, along an axis T. The frame of the reported type is the reported frame.

    Attributes:
        rotvec: (..., T, 3) rad, orientation of the frame, as in :class:`AngularFrame` and
            :class:`LinearFrame`.
        dof: (..., T, 3) int, 1 for free axes, 0 for constrained axes. Every type has the number of free axes
            of the reported type; with thresholds, each type has its own number.
        rms: (..., T, 3) rad/s or m/s, RMS velocity along each axis.
        norm: (..., T) rad/s or m/s, the lowest norm of the type.
        position: (..., T, 3) m, origin of the frame; None for angular frames.
    """

    rotvec: jax.Array
    dof: jax.Array
    rms: jax.Array
    norm: jax.Array
    position: jax.Array | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AllCandidates:
    """The best frames of all types."""

    angular: Candidates  # of the types G and B
    linear: Candidates  # of the types BB, GB, GG and BG
