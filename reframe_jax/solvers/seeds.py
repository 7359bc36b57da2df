"""Starts of a search: points that fill a box evenly, and points derived from the data."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import random

from reframe_jax.geometry.small import solve_positive
from reframe_jax.geometry.symmetric import INDEX_PAIRS, PACKED
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.protocol import repeat_problems

_RIDGE = 1e-9  # added curvature, relative to its trace: selects the origin nearest to zero among equal ones


def quasi_random(key: jax.Array, count: int, dim: int, dtype: jnp.dtype) -> jax.Array:
    """Return points (dim, count) that cover the unit cube evenly: Roberts' sequence R_d, randomly shifted.

    Any prefix of the sequence covers the cube evenly, so any ``count`` is suitable. The increments are powers
    of the real root of x^(d+1) = x + 1, the generalized golden ratio.
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dim + 1))
    steps = np.arange(1, count + 1) * root ** -np.arange(1.0, dim + 1)[:, None]
    shift = random.uniform(key, (dim, 1), dtype=dtype)
    return jnp.mod(jnp.asarray(steps % 1, dtype=dtype) + shift, 1)


def even_starts(objective: Objective, box: Box, key: jax.Array, count: int) -> jax.Array:
    """Return starts (dim, count, ...) that cover the box evenly; all problems have equal starts."""
    points = box.scale(quasi_random(key, count, objective.dim, objective.dtype))
    points = points.reshape(objective.dim, count, *([1] * len(objective.batch)))
    return jnp.broadcast_to(points, (objective.dim, count, *objective.batch))


def suggested_starts(
    objective: Objective, box: Box, key: jax.Array, count: int, candidates: int
) -> jax.Array:
    """Return starts (dim, count, ...) that are derived from the data of every problem.

    For a norm of velocities over origins, a candidate is the origin with the least motion along a random
    direction. The origin of the constraint is such a point for its constrained directions. Each start is the
    best of several candidates. For other objectives, the starts cover the box evenly.
    """
    batch, dtype = objective.batch, objective.dtype
    if not (isinstance(objective, MomentsObjective) and objective.unknowns == "position"):
        return even_starts(objective, box, key, count)
    d = partial(random.normal, shape=(3, candidates * count), dtype=dtype)(key)
    d = d.reshape(3, candidates * count, *([1] * len(batch)))
    # coefficients of d^T Sigma(p) d; its gradient is zero at the minimum
    q = jnp.zeros((10, candidates * count, *batch), dtype)
    for (a, b), row in zip(INDEX_PAIRS, objective.moments, strict=True):
        q = q + (1 if a == b else 2) * (d[a] * d[b])[None] * row[:, None]
    ridges = _RIDGE * (q[4] + q[7] + q[9])
    curvature = jnp.stack([2 * (q[4] + ridges), q[5], q[6], 2 * (q[7] + ridges), q[8], 2 * (q[9] + ridges)])
    least = solve_positive(curvature[np.array(PACKED)], -q[1:4])
    points = box.clip(jnp.where(jnp.isfinite(least), least, 0))
    values = repeat_problems(objective, len(batch), candidates * count).value(points)
    points = points.reshape(3, candidates, count, *batch)
    best = jnp.argmin(values.reshape(candidates, count, *batch), axis=0)
    return jnp.take_along_axis(points, best[None, None], axis=1)[:, 0]
