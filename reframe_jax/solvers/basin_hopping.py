"""The global search: basin hopping from many starts, for many problems at once."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.objectives.velocity import FrameObjective, PositionObjective
from reframe_jax.solvers.blocks import update_marked
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.kernel import step_chains
from reframe_jax.solvers.seeds import quasi_random
from reframe_jax.solvers.valley_steps import ValleySteps

__all__ = ["BasinHopping", "LocalMinimiser", "Objective", "SearchState", "Solution", "Solver"]

_AT_ONCE = 1024  # minimisations at a time; if there are more, restarts take turns

Objective = FrameObjective | PositionObjective
LocalMinimiser = (
    Callable[[PositionObjective, Box, jax.Array], tuple[jax.Array, jax.Array]]
    | Callable[[FrameObjective, Box, jax.Array], tuple[jax.Array, jax.Array]]
)
"""(objective, box, x (dim, ...)) -> (x, value): an improvement of every problem by itself."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Result of a global search.

    Attributes:
        x: (dim, ...) best unknowns of every problem.
        value: (...) log J there.
        agreement: (...) share of the restarts that ended within 0.1 % of the best norm.
        ends, end_values: (dim, restarts, ...) and (restarts, ...) the best of every restart, among
            which twins are looked for; None if the solver does not say.
    """

    x: jax.Array
    value: jax.Array
    agreement: jax.Array
    ends: jax.Array | None = None
    end_values: jax.Array | None = None


class Solver(Protocol):
    """What ``identify`` needs of a solver. Solvers are static arguments: make them hashable."""

    def minimise(self, objective: PositionObjective, box: Box, key: jax.Array) -> Solution:
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


_OF_CHAINS = ("x", "value", "best_x", "best_value")


@dataclass(frozen=True)
class BasinHopping:
    """Basin hopping (Wales & Doye 1997) from quasi-random restarts.

    Every restart is a chain: minimise locally; then, ``hops`` times, jump, minimise locally, and move
    there if it is better, or by Metropolis' rule if it is not; at the end minimise ``polish`` times
    more from its best point. A problem whose chains all meet after their first minimisation is settled
    and hops no more: most are, which is what makes the search fast. All problems see the same random
    numbers, so a problem's answer depends on its data and the key alone, not on its place in a batch.

    Attributes:
        inner: local minimiser: :class:`ValleySteps`, :class:`FrameSteps` or another of this package, or your
            own.
        restarts: number of chains.
        hops: jumps of each chain.
        polish: final minimisations of each chain, without a jump.
        refine: another local minimiser for the best point of all chains, or None.
        hop_size: standard deviation of a jump, as a share of the box.
        temperature: of Metropolis' rule, in log J: 0.1 accepts a 10 % larger norm once in e times.
        settled: a problem is settled if no chain ends its first minimisation this much above another,
            in log J; 0 lets every problem hop.
    """

    inner: LocalMinimiser
    restarts: int = 8
    hops: int = 2
    polish: int = 1
    refine: LocalMinimiser | None = None
    hop_size: float = 0.1
    temperature: float = 0.1
    settled: float = 1e-4

    def init(
        self, objective: Objective, box: Box, key: jax.Array, starts: jax.Array | None = None
    ) -> SearchState:
        """Starts, not minimised yet: their values are infinite.

        Args:
            objective: the problems.
            box: where to search.
            key: of the random numbers.
            starts: (dim, restarts, ...); quasi-random points, the same for all problems, by default.
        """
        batch, dtype = objective.moments.shape[2:], objective.moments.dtype
        seed_key, key = jax.random.split(key)
        if starts is None:
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
            refined, refined_value = self.refine(objective, box, x)  # type: ignore[arg-type]
            better = refined_value < value
            x, value = jnp.where(better[None], refined, x), jnp.where(better, refined_value, value)
        close = state.best_value < value[None] + 1e-3
        agreement = jnp.mean(close.astype(value.dtype), axis=0)
        return Solution(x, value, agreement, state.best_x, state.best_value)

    def minimise(
        self, objective: Objective, box: Box, key: jax.Array, starts: jax.Array | None = None
    ) -> Solution:
        """The whole search: :meth:`init`, :meth:`step` until every problem is done, :meth:`finish`.

        Arguments as in :meth:`init`. A settled problem is done after one step, the others after
        1 + ``hops`` + ``polish``. On a GPU, with :class:`ValleySteps` on the geometric mean, the steps
        run in one kernel.
        """
        state = self._advance(objective, box, self.init(objective, box, key, starts), 1)
        if self.hops + self.polish > 0:
            state = self._go_on(objective, box, state)
        return self.finish(objective, box, state)

    def _advance(self, objective: Objective, box: Box, state: SearchState, count: int) -> SearchState:
        """Make ``count`` steps."""
        in_a_kernel = jax.default_backend() == "gpu" and objective.exponent == 0
        if in_a_kernel and isinstance(self.inner, ValleySteps):
            return self._in_a_kernel(self.inner, objective, box, state, count)
        state, _ = jax.lax.scan(
            lambda state, _: (self.step(objective, box, state), None), state, length=count
        )
        return state

    def _go_on(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """Take the problems that are not settled through the other steps, gathered into full blocks."""
        batch = state.value.shape[1:]

        def flat(tree: Any) -> Any:
            return jax.tree.map(lambda a: a.reshape(*a.shape[: a.ndim - len(batch)], -1), tree)

        def further(block: tuple[Objective, dict[str, jax.Array]]) -> dict[str, jax.Array]:
            objective, chains = block
            after = self._advance(objective, box, replace(state, **chains), self.hops + self.polish)
            return {name: getattr(after, name) for name in _OF_CHAINS}

        chains = flat({name: getattr(state, name) for name in _OF_CHAINS})
        is_open = ~self._is_settled(state).reshape(-1)
        chains = update_marked(further, is_open, (flat(objective), chains), chains)
        return replace(state, **{name: a.reshape(*a.shape[:-1], *batch) for name, a in chains.items()})

    def _is_settled(self, state: SearchState) -> jax.Array:
        """Whether all chains met, (...). One chain meets nobody."""
        if self.restarts == 1:
            return jnp.zeros(state.value.shape[1:], dtype=bool)
        return jnp.max(state.value, axis=0) - jnp.min(state.value, axis=0) < self.settled

    def _in_a_kernel(
        self,
        inner: ValleySteps,
        objective: Objective,
        box: Box,
        state: SearchState,
        count: int,
        interpret: bool = False,
    ) -> SearchState:
        """The state after ``count`` steps, as :meth:`step` reaches it."""
        inner.check(objective)
        key, jumps, rises = state.key, [], []
        for _ in range(count):
            jump, rise, key = self._draw(key, objective.dim, state.x.dtype)
            jumps.append((box.high - box.low)[:, None] * jump)
            rises.append(rise)
        batch = state.value.shape[1:]

        def flat(a: jax.Array) -> jax.Array:
            return a.reshape(*a.shape[: a.ndim - len(batch)], -1)

        after = step_chains(
            flat(objective.moments),
            box.low,
            box.high,
            state.hop,
            flat(state.x),
            flat(state.value),
            flat(state.best_x),
            flat(state.best_value),
            jnp.stack(jumps),
            jnp.stack(rises),
            steps=inner.steps,
            hops=self.hops,
            interpret=interpret,
        )
        x, value, best_x, best_value = (a.reshape(*a.shape[:-1], *batch) for a in after)
        return SearchState(state.hop + count, key, x, value, best_x, best_value)

    def _descend(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Local minimisation of every chain: at once if problems are few, else one after the other."""
        if x[0].size <= _AT_ONCE:
            chains = jax.tree.map(
                lambda m: jnp.broadcast_to(m[:, :, None], (*m.shape[:2], *x.shape[1:])), objective
            )
            return self._inner(chains, box, x)
        x, value = jax.lax.map(lambda start: self._inner(objective, box, start), jnp.moveaxis(x, 1, 0))
        return jnp.moveaxis(x, 0, 1), value

    def _inner(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, value = self.inner(objective, box, x)  # type: ignore[arg-type]
        return x, jnp.where(jnp.isnan(value), jnp.inf, value)
