"""The protocol of objectives: the members that a solver uses."""

from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np

__all__ = ["MomentsObjective", "Objective", "check_objective", "require_moments"]


@runtime_checkable
class Objective(Protocol):
    """A function to minimize, for a batch of problems.

    An objective is a pytree, for example a class registered with ``jax.tree_util.register_dataclass``. Its
    arrays contain the data of the problems, with the problems as trailing axes. Data common to all problems
    must be static fields. Solvers select, repeat and flatten problems with ``jax.tree.map``, and rebuild the
    objective. Therefore ``batch`` and ``dtype`` must follow from the arrays, not from stored values.
    ``value`` must evaluate each problem independently, for any number of problem axes, including none.
    """

    @property
    def dim(self) -> int:
        """Number of unknowns per problem."""
        ...

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the batch of problems; () for a single problem."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Dtype of the unknowns and the values."""
        ...

    def value(self, x: jax.Array) -> jax.Array:
        """The objective, (...), at unknowns (dim, ...); infinite or NaN where it is undefined.

        Solvers expect the logarithm of a quantity whose relative changes matter: the temperature of
        :class:`BasinHopping` and its bounds for chains that agree are differences of values.
        """
        ...


@runtime_checkable
class MomentsObjective(Objective, Protocol):
    """A norm of velocities that depends only on their moments.

    ``ValleySteps`` and ``FrameSteps`` minimize such a norm with closed-form steps: they read the moments and
    the exponent, and call ``value`` for the result only.
    """

    @property
    def moments(self) -> jax.Array:
        """(6, 10, ...), or (6, 1, ...) for angular velocities; the trailing axes are problems."""
        ...

    @property
    def exponent(self) -> float:
        """Exponent of the power mean over the axes."""
        ...

    @property
    def unknowns(self) -> Literal["frame", "position"]:
        """Either the orientation and origin of a frame, or its origin, with the best axes at each origin."""
        ...


def check_objective(objective: Any) -> None:
    """Check the members of an objective and the shapes of its arrays, without evaluating it."""
    name = type(objective).__name__
    missing = [member for member in ("dim", "batch", "dtype", "value") if not hasattr(objective, member)]
    if missing:
        raise ValueError(
            f"An objective needs dim, batch, dtype and value; {name} has no {', '.join(missing)}."
        )
    batch = tuple(objective.batch)
    for path, leaf in jax.tree_util.tree_leaves_with_path(objective):
        if leaf is objective:
            raise ValueError(
                f"An objective must be a pytree; register {name} with jax.tree_util.register_dataclass."
            )
        shape = np.shape(leaf)
        if len(shape) < len(batch) or shape[len(shape) - len(batch) :] != batch:
            raise ValueError(
                f"Every array of an objective must end with the axes of its problems, here {batch}; "
                f"{name}{jax.tree_util.keystr(path)} has the shape {shape}. Use a static field for data that "
                "is common to all problems."
            )


def require_moments(objective: Any, unknowns: str, solver: str) -> MomentsObjective:
    """Return a :class:`MomentsObjective` over given unknowns; a ValueError names the objective otherwise."""
    if isinstance(objective, MomentsObjective) and objective.unknowns == unknowns:
        return objective
    raise ValueError(
        f"{solver} minimize norms given by moments (a {unknowns.capitalize()}Objective), not a "
        f"{type(objective).__name__}; NewtonSteps and OptaxSteps minimize any objective."
    )
