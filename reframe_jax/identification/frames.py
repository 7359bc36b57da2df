"""The frames of an identification, and the candidates among which they won."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations

__all__ = ["AllCandidates", "AngularFrame", "Candidates", "LinearFrame", "member"]


def member(kind: type[IntEnum], code: jax.Array) -> Any:
    """The enum member of a concrete scalar; anything else as it is."""
    if isinstance(code, jax.core.Tracer) or np.ndim(code):
        return code
    return kind(int(code))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AngularFrame:
    """The identified frame of the angular velocity.

    Attributes:
        type_code: (...) int, ``AngularType`` of the lowest norm; read it as ``frame_type``.
        rotvec: (..., 3) rad, orientation of the frame in the body of its type. Its axes are sorted by
            ``rms``, ascending, and right-handed; the first and third have a positive largest component.
        dof: (..., 3) int, 1 where the axis is free: those of the likeliest class, or with thresholds those
            whose ``rms`` is above.
        free_probability: (..., 3) probability that the axis is free, ascending.
        rms: (..., 3) rad/s, RMS angular velocity along each axis (lambda in the paper).
        norm: (...) rad/s, the minimised norm: the power mean of ``rms``.
        norms: (..., 2) rad/s, the norms of types G and B.
        tied: (..., 2) bool, types that explain the constraint as well as this one, to within sampling
            error; this one included.
        free_rotation: (..., 3) bool, axes about which the frame can be turned without changing the
            constraint: those whose two other axes are both free or both constrained.
    """

    type_code: jax.Array
    rotvec: jax.Array
    dof: jax.Array
    free_probability: jax.Array
    rms: jax.Array
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
        type_code: (...) int, the likeliest ``LinearType``, or with thresholds or a given lag that of the
            lowest norm; read it as ``frame_type``. That of a screw joint is GB or BG, because the norms of
            BB and GG do not tell its origin; so is that of refined frames whose class says the same in all
            types, such as a hinge, where one of these ties with it.
        rotvec: (..., 3) rad, orientation of the frame in the body of the type's first letter; axes in
            the order and handedness of :class:`AngularFrame`.
        position: (..., 3) m, origin of the frame in the body of the type's second letter. Where
            ``free_position`` leaves a choice it is the point closest to the recorded motion: to the
            mean position of {b} for GG and BG, to the origin of {b} for BB and GB.
        twin: (..., 3) m, another origin of this type that explains the window as well, to within
            sampling error, though those between the two do not; in the body of ``position``, and
            chosen like it where there is a choice. Equal to ``position`` where none was found.
        has_twin: (...) bool, whether one was.
        dof: (..., 3) int, 1 where the axis is free.
        free_probability: (..., 3) as in :class:`AngularFrame`.
        rms: (..., 3) m/s, RMS velocity along each axis at the minimum of the norm (lambda in the
            paper). Moving the origin along free directions changes those of free axes only.
        norm: (...) m/s, the minimised norm: the power mean of ``rms``.
        norms: (..., 4) m/s, the norms of types BB, GB, GG and BG.
        tied: (..., 4) bool, as in :class:`AngularFrame`.
        free_rotation: (..., 3) bool, as in :class:`AngularFrame`.
        free_position: (..., 3, 3) projector onto the directions in which the origin can be moved
            without changing the constraint (the "-" of the paper's Table 2); its trace is their number.
        coupled_position: (..., 3, 3) projector onto further directions, in which the origin can be moved if
            the axes turn along, and explain the window as well: along them neither can be told by itself.
    """

    type_code: jax.Array
    rotvec: jax.Array
    position: jax.Array
    twin: jax.Array
    has_twin: jax.Array
    dof: jax.Array
    free_probability: jax.Array
    rms: jax.Array
    norm: jax.Array
    norms: jax.Array
    tied: jax.Array
    free_rotation: jax.Array
    free_position: jax.Array
    coupled_position: jax.Array

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
    """The optimum of every frame type, the winner included; one more axis T, over the types.

    Attributes:
        rotvec: (..., T, 3) rad.
        position: (..., T, 3) m; None for angular frames.
        dof: (..., T, 3) int.
        rms: (..., T, 3) rad/s or m/s.
        norm: (..., T) rad/s or m/s.
        free_rotation: (..., T, 3) bool.
        free_position: (..., T, 3, 3); None for angular frames.
        on_bounds: (..., T) bool, whether the position lies on the bounds; None for angular frames.
        agreement: (..., T) share of the solver's restarts that found this optimum; None for angular
            frames, which need no search.
    """

    rotvec: jax.Array
    dof: jax.Array
    rms: jax.Array
    norm: jax.Array
    free_rotation: jax.Array
    position: jax.Array | None = None
    free_position: jax.Array | None = None
    on_bounds: jax.Array | None = None
    agreement: jax.Array | None = None


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
