"""Levenberg-Marquardt steps for many small problems at once. Arrays have components first and problems last.

The unknowns of a problem are groups of three; only the first group is coupled with the others. Every step
eliminates the other groups first, so that no matrix is larger than 3 x 3.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from reframe_jax.geometry.small import materialize, solve_symmetric, times, total, unit_matrix

Array = jax.Array
T = TypeVar("T")
_DAMPING = 1e-3  # first damping, as a fraction of the diagonal
_LONGEST = 0.5  # rad and m, length of a step


class Local(NamedTuple):
    """An objective about a point, G groups of unknowns."""

    value: Array  # (...) the objective
    gradient: Array  # (3, G, ...) half its gradient
    diagonal: Array  # (3, 3, G, ...) half the Hessian of every group
    coupling: Array  # (3, 3, G - 1, ...) half the Hessian of the first group with every other group


def levenberg_marquardt(
    expand: Callable[[T], Local],
    move: Callable[[T, Array], T],
    start: T,
    like: Array,
    groups: int,
    steps: int | Array,
) -> tuple[T, Array]:
    """Minimize objectives by Levenberg-Marquardt steps; return the best points, and their objectives (...).

    ``expand`` expands the objectives about points, and ``move`` moves points by a step (3, groups, ...), rad
    and m. ``like`` (...) is an array with the shape of the problems.
    """
    small = jnp.finfo(like.dtype).tiny ** 0.5

    def step(_: Array, carry: tuple[T, Local, Array]) -> tuple[T, Local, Array]:
        at, here, damping = carry
        change = _damped_step(here, damping)
        change = change * jnp.minimum(1, _LONGEST / jnp.sqrt(total(change * change, 0, 1) + small))
        there = materialize(move(at, materialize(change)))
        new = materialize(expand(there))
        lower = new.value < here.value
        at, here = jax.tree.map(lambda a, b: jnp.where(lower, a, b), (there, new), (at, here))
        return at, here, jnp.clip(jnp.where(lower, damping * 0.1, damping * 10), 1e-7, 1e4)

    # the first step has a length of zero: it only expands the objective
    none = jnp.zeros((3, groups, *like.shape), like.dtype)
    unit = unit_matrix(like.dtype, like.ndim + 1)
    nowhere = Local(jnp.full_like(like, jnp.inf), none, none + unit, jnp.stack([none[:, 1:]] * 3))
    at, here, _ = jax.lax.fori_loop(0, steps + 1, step, (start, nowhere, jnp.full_like(like, 10 * _DAMPING)))
    return at, here.value


def _damped_step(here: Local, damping: Array) -> Array:
    unit = unit_matrix(damping.dtype, damping.ndim + 1)
    size = total(here.diagonal * unit, 1)
    lift = damping * size + 100  # a step of 0.1 rad or m costs half a unit of the objective
    damped = materialize(here.diagonal + unit * lift[:, None])
    back = jnp.swapaxes(here.coupling, 0, 1)
    others = jnp.concatenate([back, here.gradient[:, None, 1:]], axis=1)  # (3, 4, groups - 1, ...)
    others = materialize(solve_symmetric(damped[:, :, 1:], others))
    away = total(times(here.coupling, others), 2)
    first = solve_symmetric(damped[:, :, 0] - away[:, :3], here.gradient[:, 0] - away[:, 3])
    first = materialize(first)[:, None]
    return jnp.concatenate([-first, times(others[:, :3], first) - others[:, 3]], axis=1)
