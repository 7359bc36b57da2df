"""One step of basin hopping, shared by arrays of chains and by the GPU kernel."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

__all__ = ["Chains", "Coordinates", "transition"]

Coordinates = jax.Array | tuple[jax.Array, ...]
"""Unknowns: an array (dim, ...), or dim arrays (...), which is what a kernel can hold."""


class Chains(NamedTuple):
    """Current and best points of chains.

    Attributes:
        x: unknowns of every chain.
        value: (...) value there.
        best_x: the best unknowns that each chain has met.
        best_value: (...) value there.
    """

    x: Coordinates
    value: jax.Array
    best_x: Coordinates
    best_value: jax.Array


def transition(
    chains: Chains,
    hop: jax.Array,
    hops: int,
    jump: Coordinates,
    rise: jax.Array,
    low: Coordinates,
    high: Coordinates,
    descend: Callable[[Coordinates], tuple[Coordinates, jax.Array]],
) -> Chains:
    """Jump, minimize locally, and accept or stay.

    The first step minimizes the starts without a jump; steps after the last hop minimize the best points. A
    chain moves if its value rises by less than ``rise``; NaN counts as infinite.

    Args:
        chains: before the step.
        hop: () steps made before.
        hops: number of jumps of a chain.
        jump: of every chain, in the unit of the unknowns; broadcasts against them, as do the bounds.
        rise: largest rise that each chain accepts; broadcasts against the values.
        low: lower faces of the box.
        high: upper faces of the box.
        descend: local minimizer, from unknowns to unknowns and their values.

    Returns:
        The chains after the step.
    """
    first, last = hop == 0, hop > hops

    def start(x: jax.Array, best: jax.Array, jump: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
        return jnp.where(first, x, jnp.where(last, best, jnp.clip(x + jump, low, high)))

    x, value = descend(jax.tree.map(start, chains.x, chains.best_x, jump, low, high))
    value = jnp.where(jnp.isnan(value), jnp.inf, value)
    accept, better = value < chains.value + rise, value < chains.best_value
    return Chains(
        _choose(accept, x, chains.x),
        jnp.where(accept, value, chains.value),
        _choose(better, x, chains.best_x),
        jnp.where(better, value, chains.best_value),
    )


def _choose(chosen: jax.Array, new: Coordinates, old: Coordinates) -> Coordinates:
    """The new unknowns of the chosen chains, the old ones of the others."""

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(chosen if new.ndim == chosen.ndim else chosen[None], new, old)

    return jax.tree.map(choose, new, old)
