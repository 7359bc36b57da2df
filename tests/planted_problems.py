"""Problems with planted constraints, and searches of them, for the tests of the solvers."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from algebra import moments_of_maps

from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.solvers import BasinHopping, Box, ValleySteps


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Callable[..., Any]:
    """``jax.jit``, as a decorator with options too."""
    return jax.jit(function, **options) if function else functools.partial(jax.jit, **options)


KEY = jax.random.key(3)
POSITIONS = Box(jnp.asarray(np.full(3, -1.0)), jnp.asarray(np.full(3, 1.0)))
FRAMES = Box(jnp.asarray([-np.pi] * 3 + [-1.0] * 3), jnp.asarray([np.pi] * 3 + [1.0] * 3))
FREE = [(1, 0, 0), (1, 1, 0), (0, 0, 0), (1, 1, 0)]  # translations of the planted constraints
NOISE = 1e-3


def planted(rng, free, noise=NOISE, samples=40):
    """Velocity maps whose velocity at a known origin is noise except along the free axes."""
    w, origin = rng.normal(size=(samples, 3)), rng.uniform(-0.5, 0.5, size=3)
    axes = np.asarray(rotation_exp(jnp.asarray(rng.normal(size=3))))
    along = (0.3 * np.array(free) * rng.normal(size=(samples, 3))) @ axes.T
    turn = np.stack([np.cross(w, e) for e in np.eye(3)], axis=-1)
    a = along + noise * rng.normal(size=(samples, 3)) - np.cross(w, origin)
    return np.concatenate([a[..., None], turn], axis=-1), origin


RNG = np.random.default_rng(11)
WINDOWS, ORIGINS = zip(*(planted(RNG, free) for free in FREE), strict=True)


@functools.cache
def four_moments():
    """Of the four problems, (6, 10, 4)."""
    return moments_of_maps(jnp.asarray(np.stack(WINDOWS)))


VALLEY = BasinHopping(ValleySteps(10), restarts=4, hops=1)


@compiled(static_argnums=0)
def search(solver, moments, key, box):
    return solver.minimise(PositionObjective(moments), box, key)


def search_positions(solver, moments, key=KEY, box=POSITIONS):
    return search(solver, moments, key, box)


frame_value = compiled(lambda moments, x: FrameObjective(moments).value(x))
