"""The protocol of objectives: the members that solvers use, and checks of these members."""

from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np


@runtime_checkable
class Objective(Protocol):
    """A function to minimize, for a batch of problems with different data.

    An objective is a pytree, for example a class registered with ``jax.tree_util.register_dataclass``. Its
    arrays contain the data of the problems; their trailing axes are the problems. Data that is common to all
    problems must be static fields. Solvers select, repeat and flatten problems with ``jax.tree.map``, and
    rebuild the objective. Therefore compute ``batch`` and ``dtype`` from the arrays, and let ``value``
    evaluate each problem independently, for any number of problem axes, including none.
    """

    @property
    def dim(self) -> int:
        """Number of unknowns per problem."""

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the batch of problems; () for a single problem."""

    @property
    def dtype(self) -> np.dtype:
        """Dtype of the unknowns and the values."""

    def value(self, x: jax.Array) -> jax.Array:
        """Return the values (...) at unknowns (dim, ...); infinite or NaN where the function is undefined.

        For a positive quantity such as a norm, return its logarithm: solvers compare differences of values
        with fixed limits (the temperature and the tolerance of :class:`BasinHopping`).
        """


@runtime_checkable
class MomentsObjective(Objective, Protocol):
    """A norm of velocities that is computed from their second moments.

    ``ValleySteps`` and ``FrameSteps`` minimize such a norm. They compute their steps from the moments and the
    exponent, and call ``value`` for the result only.
    """

    @property
    def moments(self) -> jax.Array:
        """Coefficients (6, 10, ...) of the velocity covariance, or (6, 1, ...) for angular velocities."""

    @property
    def exponent(self) -> float:
        """Exponent of the power mean over the axes."""

    @property
    def unknowns(self) -> Literal["frame", "position"]:
        """What the solver varies: "frame" (orientation and origin) or "position" (origin, best axes)."""


def check_objective(objective: Any) -> None:
    """Check the members of an objective and the shapes of its arrays, without a call of ``value``.

    Raises:
        ValueError: for a missing member, an object that is not a pytree, or an array without problem axes.
    """
    name = type(objective).__name__
    missing = [member for member in ("dim", "batch", "dtype", "value") if not hasattr(objective, member)]
    if missing:
        raise ValueError(f"Objectives need dim, batch, dtype and value; {name} has no {', '.join(missing)}.")
    batch = tuple(objective.batch)
    for path, leaf in jax.tree_util.tree_leaves_with_path(objective):
        if leaf is objective:
            raise ValueError(f"Objectives are pytrees; register {name} by jax.tree_util.register_dataclass.")
        shape = np.shape(leaf)
        if len(shape) < len(batch) or shape[len(shape) - len(batch) :] != batch:
            raise ValueError(
                f"Every array of an objective must end with the axes of its problems, here {batch}; "
                f"{name}{jax.tree_util.keystr(path)} has the shape {shape}. Use a static field for data that "
                "is common to all problems."
            )
