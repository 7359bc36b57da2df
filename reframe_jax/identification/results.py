"""The result of an identification.

All results are pytrees, which ``jit``, ``vmap`` and indexing accept. Types and status are stored as integer
codes. The properties ``frame_type`` and ``status`` are enum members for a single window, and arrays of codes
for a batch; a code compares equal to its enum member.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import Index, index_leaves, traced
from reframe_jax.constraints.catalogue import Constraint, describe
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, Dof, LinearType
from reframe_jax.identification.cautions import caution_sentences
from reframe_jax.identification.certainty import Covariance, Excitation
from reframe_jax.identification.explanation import explain_window, in_brackets
from reframe_jax.identification.frames import AllCandidates, AngularFrame, LinearFrame, PoseNoise, member
from reframe_jax.identification.naming import NAME_OF_ENTRY, constraint_of, name_of
from reframe_jax.joints.fitting import fit_joint
from reframe_jax.joints.joint import Joint
from reframe_jax.motion.checks import Status

_LEVERS = 0.03, 3.0  # m, limits of the lever: the ratio of the position noise to the orientation noise
_USUAL_LEVER = 0.3  # m, lever if the noise is unknown


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Identification:
    """The identified constraint of a window, or of every window of a batch.

    Attributes:
        angular: angular frame: axes of free and constrained rotations.
        linear: linear frame: origin, and axes of its free and constrained translations.
        candidates: the best frame of every type.
        entry_code: (...) int, index of the reported constraint in :data:`reframe_jax.model.table.ENTRIES`.
        entry_probability: (..., E) probability of every entry of the table; NaN with thresholds.
        pitch: (...) m/rad, translation of a screw joint along its axis per radian of rotation, positive for a
            right-handed thread. Multiply by 2 pi for the lead in m per turn. NaN for other constraints.
        universal_axes: (..., 2, 3) unit vectors of a universal joint: its axis in {g} and its axis in {b}.
            NaN for other constraints, and with thresholds.
        noise: estimated white noise of the poses.
        scale: (...) int, smallest time scale that is used, in samples; 1 for single steps.
        counted: (..., K+1) bool, False for outliers, which were left out.
        status_code: (...) int; read it as ``status``. The numbers of failed windows are NaN or zero.
        warning_codes: (...) int, bits of :class:`reframe_jax.identification.cautions.Caution`; read them as
            ``warnings``.
    """

    angular: AngularFrame
    linear: LinearFrame
    candidates: AllCandidates
    entry_code: jax.Array
    entry_probability: jax.Array
    pitch: jax.Array
    universal_axes: jax.Array
    noise: PoseNoise
    scale: jax.Array
    counted: jax.Array
    status_code: jax.Array
    warning_codes: jax.Array

    def __repr__(self) -> str:
        """Summarize the result in a line: the name, or the most frequent names of a batch."""
        if not isinstance(self.status_code, jax.Array | np.ndarray | np.generic) or traced(self.status_code):
            return object.__repr__(self)
        if not (shape := np.shape(self.status_code)):
            return f"<Identification: {self.name}{in_brackets(self.probability)}>"
        common = Counter(name.split(":")[0] for name in self.name.ravel()).most_common(3)
        names = ", ".join(f"{count} {name}" for name, count in common)
        return f"<Identification of {shape} windows: {names}>"

    def __getitem__(self, index: Index) -> "Identification":
        """Select windows of a batch by an index, as in an array."""
        return index_leaves(self, index)

    def __iter__(self) -> Iterator["Identification"]:
        """Iterate over the first axis of a batch."""
        if not np.ndim(self.status_code):
            raise TypeError("This is the identification of a single window, not of a batch.")
        return (self[row] for row in range(len(self.status_code)))

    @property
    def status(self) -> Any:
        """``Status`` of a single window; integer codes of a batch."""
        return member(Status, self.status_code)

    @property
    def warnings(self) -> Any:
        """Reasons to doubt the result: a list of sentences for a single window, codes for a batch.

        Tables, JSON documents and the command line contain the same sentences.
        """
        if isinstance(self.warning_codes, jax.core.Tracer) or np.ndim(self.warning_codes):
            return self.warning_codes
        velocities = int(np.sum(np.asarray(self.counted))) - 1
        speeds = np.asarray(self.angular.rms).tolist(), np.asarray(self.linear.rms).tolist()
        bounds = [Status.ON_BOUNDS.message] if self.status == Status.ON_BOUNDS else []
        return bounds + caution_sentences(int(self.warning_codes), velocities, speeds, self.probability)

    @property
    def entry(self) -> Constraint | None:
        """Constraint of a single window in the catalogue, not in the table; None if it has no name."""
        check_single(self)
        code = int(self.entry_code)
        return constraint_of(code) if code >= 0 else None

    @property
    def name(self) -> Any:
        """Name of the constraint; an array of names for a batch.

        A constraint outside the catalogue has a description ("Unnamed: 3 rotations, 1 translation in GB").
        The name of a failed window is "No result: " and the message of its status.
        """
        codes, statuses = np.asarray(self.entry_code), np.asarray(self.status_code)
        every = zip(codes.ravel().tolist(), statuses.ravel().tolist(), strict=True)
        names = np.empty(codes.size, object)
        names[:] = [self._name(i, *pair) for i, pair in enumerate(every)]
        return names.reshape(codes.shape)[()]  # the name itself for a single window

    def _name(self, place: int, code: int, status: int) -> str:
        if Status(status).failed:
            return f"No result: {Status(status).message}"
        if code >= 0:
            return name_of(code)
        kind = LinearType(int(np.asarray(self.linear.type_code).ravel()[place]))
        dof = [np.asarray(x).reshape(-1, 3)[place] for x in (self.angular.dof, self.linear.dof)]
        return describe(kind, _dof(dof[0]), _dof(dof[1]))

    @property
    def probability(self) -> Any:
        """Probability of ``name``: a float, or an array for a batch; NaN for failed windows.

        The probability is the sum of ``entry_probability`` over all entries with this name. It assumes that
        one constraint of the table applied during the whole window (:mod:`reframe_jax.model.evidence`). A
        free axis that the motion did not use is reported as constrained, possibly with a high probability.
        With thresholds, the probability is NaN.
        """
        inside = traced(self.entry_probability)
        xp: Any = jnp if inside else np
        every, codes = xp.asarray(self.entry_probability, float), xp.asarray(self.entry_code)
        same = xp.asarray(NAME_OF_ENTRY)[xp.maximum(codes, 0)][..., None] == NAME_OF_ENTRY
        failed = (xp.asarray(self.status_code) >= 10) | xp.isnan(every[..., 0]) | (codes < 0)
        found = xp.where(failed, np.nan, xp.where(same, every, 0).sum(axis=-1))
        return found if inside or found.ndim else float(found)

    @property
    def constraint_frame(self) -> ConstraintFrame:
        """Types, degrees of freedom and geometry of a single window, for simulation or control.

        A screw joint has the frame of a cylinder joint; ``pitch`` contains the coupling. A universal joint
        whose second axis turned by a large angle has the frame of a spherical joint; ``universal_axes``
        contains its axes.

        Raises:
            ValueError: for a batch.
        """
        check_single(self)
        return ConstraintFrame(
            angular_type=AngularType(int(self.angular.type_code)),
            angular_dof=_dof(self.angular.dof),
            linear_type=LinearType(int(self.linear.type_code)),
            linear_dof=_dof(self.linear.dof),
            angular_rotvec=self.angular.rotvec,
            linear_rotvec=self.linear.rotvec,
            position=self.linear.position,
        )

    def to_joint(self, poses: "ArrayLike", *, parent: str = "ground", child: str = "body") -> Joint:
        """Convert the constraint of a single window to a joint for robot descriptions; see :class:`Joint`.

        Args:
            poses: (K+1, 4, 4) m, the identified poses; outliers are ignored.
            parent: name of the ground {g} in the joint.
            child: name of the body {b} in the joint.

        Raises:
            ValueError: for a batch, for a failed window, or if the number of poses is not the identified
                number.
        """
        check_single(self)
        if self.status.failed:
            raise ValueError(f"There is no joint: {self.status.message}")
        values, counted = np.asarray(poses, dtype=float), np.asarray(self.counted)
        if values.shape != (*counted.shape, 4, 4):
            expected = (*counted.shape, 4, 4)
            raise ValueError(f"Expected the poses that were identified, {expected}, not {values.shape}.")
        position, rotation = float(self.noise.position), float(self.noise.rotation)
        known = position > 0 and rotation > 0
        lever = float(np.clip(position / rotation, *_LEVERS)) if known else _USUAL_LEVER
        pitch, universal = float(self.pitch), np.asarray(self.universal_axes, float)
        return fit_joint(
            self.constraint_frame,
            values[counted],
            parent=parent,
            child=child,
            length=lever,
            pitch=pitch if np.isfinite(pitch) else None,
            universal=universal if np.isfinite(universal).all() else None,
        )

    def explain(self, covariance: Covariance | None = None, excitation: Excitation | None = None) -> str:
        """Explain the result of a single window in up to six lines of plain English.

        The lines state the constraint, its probability, the displacements along constrained and free axes,
        the origin, the axis, what the motion does not determine, and which motion to record.

        Args:
            covariance: covariance of this window, from :func:`reframe_jax.covariance`, for 95 % error bars.
            excitation: excitation of this window, from :func:`reframe_jax.excitation`, for the degrees of
                freedom that the motion did not test.

        Raises:
            ValueError: for a batch.
        """
        check_single(self)
        host = jax.tree.map(np.asarray, self)
        return str(host.name) if host.status.failed else explain_window(host, covariance, excitation)


def check_single(found: Identification) -> None:
    """Raise a ValueError for the identification of a batch."""
    if np.shape(found.status_code):
        raise ValueError("A batch has several constraints: index one window first, found[i].")


def _dof(dof: ArrayLike) -> Dof:
    x, y, z = (int(d) for d in np.asarray(dof))
    return x, y, z
