"""What a motion could tell: constraints that moved too simply look simpler than they are.

A constraint is read off the velocities that did not occur. Velocities that nobody tried do not occur either,
and two that keep one ratio cancel somewhere: at that point the body seems to have one freedom less. Three
kinds of motion therefore say less than their frames show:

- the body followed a single path, back and forth: nothing but that path was tested;
- a velocity never changed: with any other steady velocity it keeps one ratio;
- velocities of free axes were proportional, so that fewer motions were made than axes are free.
"""

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.arrays import jnp
from reframe_jax.compilation import index_leaves
from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS
from reframe_jax.constraints.types import LinearType
from reframe_jax.identification.results import Identification, Index
from reframe_jax.uncertainty.inputs import over_windows
from reframe_jax.uncertainty.paths import Estimates, paths_of

__all__ = ["Excitation", "excitation", "possible_constraints"]

_STEADY = 0.03  # share of a constant that no velocity explains, below which one of them is constant
_PROPORTIONAL = 1e-3  # share of a free velocity that the others do not explain, below which it is no motion
_NOISES = 3.0  # noises that a motion has at least


_NAMED = np.zeros((4, 4, 4), bool)  # linear type, free rotations, free translations
for _entry in (*CONSTRAINTS.values(), *OTHER_CONSTRAINTS.values()):
    _types = slice(None) if _entry.linear_type is None else int(_entry.linear_type)
    _NAMED[_types, sum(_entry.angular_dof), sum(_entry.linear_dof)] = True


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Excitation:
    """How much of a constraint a motion tested.

    Attributes:
        free: (...) int, degrees of freedom of the class that was found.
        motions: (...) int, how many of them moved independently of each other.
        steady: (...) bool, whether a velocity, or a sum of velocities, was constant throughout.
        named: (...) bool, whether a mechanism with a name has as many freedoms of each kind in a frame of
            that type; if none has, an axis was probably not tried.
    """

    free: jax.Array
    motions: jax.Array
    steady: jax.Array
    named: jax.Array

    def __getitem__(self, index: Index) -> "Excitation":
        """Windows of a batch, indexed like an array."""
        return index_leaves(self, index)

    @property
    def one_path(self) -> jax.Array:
        """(...) bool, whether the body followed a single path, as on a hinge or a rail."""
        return self.motions == 1

    @property
    def determined(self) -> jax.Array:
        """(...) bool, whether the motion tells the class: two or more independent, changing motions.

        If not, what was found is what moved; the mechanism may have more freedom.
        """
        return (self.motions > 1) & (self.motions == self.free) & ~self.steady & self.named


def possible_constraints(found: Identification) -> tuple[str, ...]:
    """Names of the constraints whose freedom includes all that moved in one window, the found one first.

    A constraint is possible if it has as many free rotations and translations or more, and its linear type is
    among the tied ones.
    """
    angular, linear = int(np.sum(found.angular.dof)), int(np.sum(found.linear.dof))
    tied = [kind for kind in LinearType if found.linear.tied[kind] or kind == found.linear.type_code]
    names = [found.name]
    for entry in CONSTRAINTS.values():
        enough = sum(entry.angular_dof) >= angular and sum(entry.linear_dof) >= linear
        # the type of a hinge says nothing: every point beside its axis slides along a circle
        fits = entry.linear_type is None or linear == 0 or entry.linear_type in tied
        if enough and fits and entry.name not in names:
            names.append(entry.name)
    return tuple(names)


def excitation(
    found: Identification,
    poses: ArrayLike,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    compiled: bool | None = None,
) -> Excitation:
    """Say how much of the constraint a motion tested.

    Args:
        found: by :func:`reframe_jax.identify` from these poses.
        poses: (..., K+1, 4, 4), as given to it.
        times: (K+1,) or (..., K+1) s, as given to it.
        dt: s, as given to it.
        compiled: whether a program that JAX compiles computes it, or NumPy; see :func:`reframe_jax.identify`.

    Returns:
        The excitation, with the leading axes of ``found``.

    Raises:
        ValueError: if the poses are not those of ``found``.
    """
    return over_windows(_of_windows, found, poses, times, dt, compiled=compiled)


def _of_windows(poses: jax.Array, found: Estimates, steps: jax.Array, count: jax.Array | None) -> Excitation:
    failed = ~jnp.isfinite(found.position[:, 0])
    paths = paths_of(poses, steps, count, found)
    sampling = paths.sampling
    velocities = sampling.chords(jnp.concatenate([paths.along_angular, paths.along_linear]))
    dof = jnp.concatenate([found.angular_dof.T, found.linear_dof.T])
    free = (dof == 1).astype(poses.dtype)
    moving = velocities * free[:, None]
    weights = jnp.square(sampling.scales)
    ones = jnp.sqrt(weights / _positive(jnp.sum(weights, axis=0))[None])
    lever = jnp.sqrt(jnp.max(jnp.sum(jnp.square(paths.shift), axis=0), axis=0))
    span = jnp.sqrt(2 * jnp.sum(weights, axis=0))  # rms of 1/s, for the noise of two poses
    turning = found.rotation_noise * span
    sliding = jnp.sqrt(found.position_noise**2 + (found.rotation_noise * lever) ** 2) * span
    noise = jnp.concatenate([jnp.broadcast_to(x, (3, *x.shape)) for x in (turning, sliding)])
    gram = jnp.stack([jnp.sum(row[None] * moving, axis=1) for row in moving])
    size = jnp.sqrt(jnp.stack([gram[i, i] for i in range(6)]))
    scale = jnp.where(free > 0, 1 / _positive(size), 0)
    level = jnp.square(_NOISES * noise * scale)
    motions = _independent(gram * scale[:, None] * scale[None], level, free)
    steady = _steady(velocities, ones, free, noise)
    number = jnp.sum(dof, axis=0, dtype=jnp.int32)
    return Excitation(
        free=jnp.where(failed, 0, number),
        motions=jnp.where(failed, 0, motions),
        steady=steady & ~failed & (number > 0),
        named=jnp.asarray(_NAMED)[
            found.linear_type, jnp.sum(found.angular_dof, 1), jnp.sum(found.linear_dof, 1)
        ]
        & ~failed,
    )


def _positive(x: jax.Array) -> jax.Array:
    return jnp.maximum(x, jnp.finfo(x.dtype).tiny)


def _independent(correlation: jax.Array, level: jax.Array, free: jax.Array) -> jax.Array:
    """Number of independent motions, (N,), by pivoted elimination: each leaves what it does not explain.

    Args:
        correlation: (6, 6, N), zero for constrained axes.
        level: (6, N) what noise makes of the diagonal.
        free: (6, N) 1 for free axes.
    """
    threshold = jnp.maximum(level, _PROPORTIONAL)
    rest, number = correlation, jnp.zeros(free.shape[1], jnp.int32)
    for _ in range(6):
        left = jnp.stack([rest[i, i] for i in range(6)])
        margin = jnp.where(free > 0, left - threshold, -1)
        best = jnp.argmax(margin, axis=0)
        there = jnp.max(margin, axis=0) > 0
        row = jnp.take_along_axis(rest, best[None, None], axis=0)[0]
        pivot = jnp.take_along_axis(left, best[None], axis=0)
        share = row / jnp.where(there[None], pivot, 1)
        rest = jnp.where(there[None, None], rest - row[:, None] * share[None], rest)
        number = number + there.astype(jnp.int32)
    return number


def _steady(velocities: jax.Array, ones: jax.Array, free: jax.Array, noise: jax.Array) -> jax.Array:
    """Whether some sum of the free velocities is constant, (N,): least squares of 1 by all of them."""
    moving = velocities * free[:, None]
    size = jnp.sqrt(jnp.sum(jnp.square(moving), axis=1))
    unit = moving * jnp.where(free > 0, 1 / _positive(size), 0)[:, None]
    gram = jnp.stack([jnp.sum(row[None] * unit, axis=1) for row in unit])
    mean = jnp.sum(unit * ones[None], axis=1)
    # noise keeps combinations of proportional velocities from explaining anything
    ridge = jnp.where(free > 0, jnp.square(noise / _positive(size)) + 1e-9, 1.0)
    system = jnp.moveaxis(gram, -1, 0) + jnp.eye(6, dtype=gram.dtype)[None] * ridge.T[:, None]
    weights = jnp.linalg.solve(system, mean.T[..., None])[..., 0]
    return 1 - jnp.sum(weights * mean.T, axis=1) < _STEADY
