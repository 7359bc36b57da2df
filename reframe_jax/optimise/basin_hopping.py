"""The global search: basin hopping from many starts, for many problems at once."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import chunk_size
from reframe_jax.frames import LinearType
from reframe_jax.objectives import FrameObjective, PositionObjective
from reframe_jax.optimise.box import Box
from reframe_jax.optimise.kernel import search_chains
from reframe_jax.optimise.seeds import quasi_random
from reframe_jax.optimise.valley import ValleySteps

__all__ = ["BasinHopping", "LocalMinimiser", "Objective", "SearchState", "Solution", "Solver"]

Objective = FrameObjective | PositionObjective
LocalMinimiser = Callable[[Any, Box, jax.Array], tuple[jax.Array, jax.Array]]
"""(objective, box, x (dim, ...)) -> (x, value): an improvement of every problem by itself."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of a global search.

    Attributes:
        x: (dim, ...) best unknowns of every problem.
        value: (...) log J there.
        agreement: (...) share of the restarts that ended within 0.1 % of the best norm.
    """

    x: jax.Array
    value: jax.Array
    agreement: jax.Array


class Solver(Protocol):
    """What ``identify`` needs of a solver. Solvers are static arguments: make them hashable."""

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Search every problem of the objective."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchState:
    """What :meth:`BasinHopping.step` carries from hop to hop.

    Attributes:
        hop: steps made; see :meth:`BasinHopping.step`.
        key: of the random numbers to come.
        x, value: (dim, restarts, ...) and (restarts, ...): where each chain is.
        best_x, best_value: (dim, restarts, ...) and (restarts, ...): the best each chain has met.
    """

    hop: jax.Array
    key: jax.Array
    x: jax.Array
    value: jax.Array
    best_x: jax.Array
    best_value: jax.Array


@dataclass(frozen=True)
class BasinHopping:
    """Basin hopping (Wales & Doye 1997) from quasi-random restarts.

    Every restart is a chain: minimise locally; then, ``hops`` times, jump, minimise locally, and move
    there if it is better, or by Metropolis' rule if it is not; at the end minimise ``polish`` times
    more from its best point. All problems see the same random numbers, so a problem's answer depends
    on its data and the key alone, not on its place in a batch.

    Attributes:
        inner: local minimiser, :class:`ValleySteps`, :class:`OptaxSteps` or your own.
        restarts: number of chains.
        hops: jumps of each chain.
        polish: final minimisations of each chain, without a jump.
        refine: another local minimiser for the best point of all chains, or None.
        hop_size: standard deviation of a jump, as a share of the box.
        temperature: of Metropolis' rule, in log J: 0.1 accepts a 10 % larger norm once in e times.
    """

    inner: LocalMinimiser
    restarts: int = 8
    hops: int = 2
    polish: int = 1
    refine: LocalMinimiser | None = None
    hop_size: float = 0.1
    temperature: float = 0.1

    def init(self, objective: Objective, box: Box, key: jax.Array) -> SearchState:
        """Quasi-random starts, not minimised yet: their values are infinite."""
        batch, dtype = objective.moments.shape[2:], objective.moments.dtype
        seed_key, key = jax.random.split(key)
        starts = box.scale(quasi_random(seed_key, self.restarts, objective.dim, dtype))
        starts = starts.reshape(objective.dim, self.restarts, *([1] * len(batch)))
        x = jnp.broadcast_to(starts, (objective.dim, self.restarts, *batch))
        value = jnp.full(x.shape[1:], jnp.inf, dtype=dtype)
        return SearchState(jnp.zeros((), jnp.int32), key, x, value, x, value)

    def step(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """One step of every chain: jump, minimise, and accept or stay.

        The first step minimises the starts as they are, those after the last hop the best points.
        """
        jump, rise, key = self._draw(state.key, objective.dim, state.x.dtype)
        more = (1,) * (state.x.ndim - 2)
        low, high = box.bounds(state.x)
        hopped = box.clip(state.x + (high - low) * jump.reshape(*jump.shape, *more))
        start = jnp.where(state.hop == 0, state.x, jnp.where(state.hop > self.hops, state.best_x, hopped))
        x, value = self._descend(objective, box, start)
        accept = value < state.value + rise.reshape(*rise.shape, *more)
        better = value < state.best_value
        return SearchState(
            hop=state.hop + 1,
            key=key,
            x=jnp.where(accept[None], x, state.x),
            value=jnp.where(accept, value, state.value),
            best_x=jnp.where(better[None], x, state.best_x),
            best_value=jnp.where(better, value, state.best_value),
        )

    def _draw(self, key: jax.Array, dim: int, dtype: np.dtype) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Jump of every chain as a share of the box, (dim, restarts), the rise it accepts, the next key."""
        jump_key, accept_key, key = jax.random.split(key, 3)
        jump = self.hop_size * jax.random.normal(jump_key, (dim, self.restarts), dtype=dtype)
        chance = jax.random.uniform(accept_key, (self.restarts,), dtype=dtype)
        return jump, -self.temperature * jnp.log(chance), key

    def finish(self, objective: Objective, box: Box, state: SearchState) -> Solution:
        """Refine the best point of all chains."""
        winner = jnp.argmin(state.best_value, axis=0)
        x = jnp.take_along_axis(state.best_x, winner[None, None], axis=1)[:, 0]
        value = jnp.min(state.best_value, axis=0)
        if self.refine is not None:
            refined, refined_value = self.refine(objective, box, x)
            better = refined_value < value
            x, value = jnp.where(better[None], refined, x), jnp.where(better, refined_value, value)
        close = state.best_value < value[None] + 1e-3
        return Solution(x, value, jnp.mean(close.astype(value.dtype), axis=0))

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """The whole search: :meth:`init`, 1 + ``hops`` + ``polish`` times :meth:`step`, :meth:`finish`.

        On a GPU, with :class:`ValleySteps`, all the steps are one kernel.
        """
        if isinstance(self.inner, ValleySteps) and jax.default_backend() == "gpu":
            return self.finish(objective, box, self._in_a_kernel(self.inner, objective, box, key))
        state, _ = jax.lax.scan(
            lambda state, _: (self.step(objective, box, state), None),
            self.init(objective, box, key),
            length=1 + self.hops + self.polish,
        )
        return self.finish(objective, box, state)

    def _in_a_kernel(
        self, inner: ValleySteps, objective: Objective, box: Box, key: jax.Array, interpret: bool = False
    ) -> SearchState:
        """The state after all steps, as :meth:`minimise` reaches it step by step."""
        inner.check(objective)
        state, dim = self.init(objective, box, key), objective.dim
        key, draws = state.key, []
        for _ in range(1 + self.hops):  # the first step jumps nowhere
            jump, rise, key = self._draw(key, dim, state.x.dtype)
            draws.append(((box.high - box.low)[:, None] * jump, rise))
        x, value = search_chains(
            objective.moments.reshape(6, 10, -1),
            box.low,
            box.high,
            state.x.reshape(dim, self.restarts, -1)[:, :, 0],
            jnp.stack([jump for jump, _ in draws[1:]]) if self.hops else jnp.zeros((1, dim, self.restarts)),
            jnp.stack([rise for _, rise in draws[1:]]) if self.hops else jnp.zeros((1, self.restarts)),
            steps=inner.steps,
            hops=self.hops,
            polish=self.polish,
            interpret=interpret,
        )
        x, value = x.reshape(state.x.shape), value.reshape(state.value.shape)
        return SearchState(state.hop + 1 + self.hops + self.polish, key, x, value, x, value)

    def _descend(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Local minimisation of every chain: at once if problems are few, else one after the other."""
        if x[0].size <= chunk_size() * len(LinearType):
            chains = jax.tree.map(
                lambda m: jnp.broadcast_to(m[:, :, None], (*m.shape[:2], *x.shape[1:])), objective
            )
            return self._inner(chains, box, x)
        x, value = jax.lax.map(lambda start: self._inner(objective, box, start), jnp.moveaxis(x, 1, 0))
        return jnp.moveaxis(x, 0, 1), value

    def _inner(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, value = self.inner(objective, box, x)
        return x, jnp.where(jnp.isnan(value), jnp.inf, value)
