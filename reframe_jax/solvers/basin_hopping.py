"""The global search: basin hopping from many starts, for many problems at once."""

from dataclasses import dataclass
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random

from reframe_jax.compilation import BLOCK_SHARE, update_marked
from reframe_jax.objectives.protocol import Objective, check_objective
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.problems import flatten_problems, repeat_problems
from reframe_jax.solvers.protocol import LocalMinimiser, Solution
from reframe_jax.solvers.seeds import even_starts, suggested_starts
from reframe_jax.solvers.transition import Chains, Coordinates, transition

__all__ = ["BasinHopping", "SearchState"]

_FEW = 4  # problems, those of one window, that are searched in a single loop
_AT_ONCE = 1024  # minimizations at a time; if there are more, restarts take turns
_SUGGESTED = 0.4  # share of the chains that start where the data suggest
_CANDIDATES = 4, 64  # of every such start, and of every chain that begins a round afresh
_LATER = 256  # on an accelerator, rounds after the first take this part of all problems at a time


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

    @property
    def chains(self) -> Chains:
        """All but the count of steps and the key."""
        return Chains(self.x, self.value, self.best_x, self.best_value)


def _state(hop: jax.Array, key: jax.Array, chains: Chains) -> SearchState:
    x, best_x = cast(jax.Array, chains.x), cast(jax.Array, chains.best_x)
    return SearchState(hop, key, x, chains.value, best_x, chains.best_value)


def _where(chosen: jax.Array, new: Chains, old: Chains) -> Chains:
    """The new chains of the chosen problems (...), the old ones of the others."""
    return jax.tree.map(lambda a, b: jnp.where(jnp.broadcast_to(chosen, a.shape), a, b), new, old)


def _lowest(chains: Chains) -> tuple[jax.Array, jax.Array]:
    """The best point that any chain has met, (dim, 1, ...), and the value there, (1, ...)."""
    best = jnp.argmin(chains.best_value, axis=0)[None]
    x = jnp.take_along_axis(cast(jax.Array, chains.best_x), best[None], axis=1)
    return x, jnp.take_along_axis(chains.best_value, best, axis=0)


def _with_best(ends: Chains, chains: Chains) -> Chains:
    """Where chains ended in the first round, and instead of the highest end what later rounds found below.

    Chains that begin afresh are led to the lowest values. Those of the first round ended wherever the valleys
    led them, in other optima of nearly the same value too.
    """
    x, value = _lowest(chains)
    rank = jnp.arange(len(ends.best_value)).reshape(-1, *([1] * (ends.best_value.ndim - 1)))
    highest = rank == jnp.argmax(ends.best_value, axis=0)[None]
    put = highest & (value < jnp.min(ends.best_value, axis=0)[None])
    best_x = jnp.where(put[None], x, cast(jax.Array, ends.best_x))
    return ends._replace(best_x=best_x, best_value=jnp.where(put, value, ends.best_value))


@dataclass(frozen=True)
class BasinHopping:
    """Basin hopping (Wales & Doye 1997) from quasi-random restarts.

    Every restart is a chain. It minimizes locally; then, ``hops`` times, it jumps, minimizes locally, and
    moves there if the value is lower or Metropolis' rule accepts it; finally it minimizes ``polish`` more
    times from its best point. A problem whose chains all agree after the first minimization is settled and
    stops hopping. Most problems settle, which makes the search fast. All problems use the same random
    numbers, so the answer depends on the data of the problem and the key, not on its place in a batch.

    With ``rounds``, some chains start where the data suggest (see :func:`suggested_starts`), and a problem
    that did not settle goes through rounds until all its chains have met at the best value. In the first they
    go on from where they are. In each of the others one chain goes on from the best point, the others begin
    afresh where the data suggest. These minimize from there without a jump; the other ``hops`` + ``polish`` -
    1 steps follow. Slow motion, whose valleys are many and narrow, needs rounds.

    :meth:`minimise` is the whole search. To watch a search or stop it early, call ``init``, then ``step`` 1 +
    ``hops`` + ``polish`` times, then ``finish``. All three are pure functions of arrays that may be compiled;
    every problem takes all steps, settled or not, and none goes through rounds.

    Attributes:
        inner: local minimizer, such as :class:`ValleySteps` or :class:`FrameSteps`, or your own.
        restarts: number of chains.
        hops: jumps of each chain.
        polish: final minimizations of each chain, without a jump.
        refine: another local minimizer for the best point of all chains, or None.
        hop_size: standard deviation of a jump, as a share of the box.
        temperature: of Metropolis' rule, in log J: 0.1 accepts a 10 % larger norm once in e times.
        settled: largest difference in log J between the chains of a settled problem after their first
            minimization; 0 makes every problem hop.
        rounds: the most that a problem goes through; 0 lets its chains hop once, from where they are.
    """

    inner: LocalMinimiser
    restarts: int = 8
    hops: int = 2
    polish: int = 1
    refine: LocalMinimiser | None = None
    hop_size: float = 0.1
    temperature: float = 0.1
    settled: float = 1e-4
    rounds: int = 0

    def init(
        self, objective: Objective, box: Box, key: jax.Array, starts: jax.Array | None = None
    ) -> SearchState:
        """Return the starts before any minimization; their values are infinite.

        Args:
            objective: the problems.
            box: where to search.
            key: of the random numbers.
            starts: (dim, restarts, ...); by default quasi-random points, the same for all problems, and
                those that the data suggest.

        Raises:
            ValueError: if the objective is not an :class:`Objective`.
        """
        check_objective(objective)
        batch, dtype = objective.batch, objective.dtype
        seed_key, key = random.split(key)
        if starts is None:
            starts = self._starts(objective, box, seed_key)
        x = jnp.broadcast_to(starts, (objective.dim, self.restarts, *batch))
        value = jnp.full(x.shape[1:], jnp.inf, dtype=dtype)
        return SearchState(jnp.zeros((), jnp.int32), key, x, value, x, value)

    def _starts(self, objective: Objective, box: Box, key: jax.Array) -> jax.Array:
        """Where the chains start, (dim, restarts, ...)."""
        suggested = round(_SUGGESTED * self.restarts) if self.rounds else 0
        filling = self.restarts - suggested
        starts = even_starts(objective, box, key, filling)
        if suggested == 0:
            return starts
        more = suggested_starts(objective, box, random.fold_in(key, 1), suggested, _CANDIDATES[0])
        return jnp.concatenate([starts, more], axis=1)

    def step(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """One step of every chain: jump, minimize, and accept or stay.

        The first step minimizes the starts without a jump; steps after the last hop minimize the best points.
        """
        draw = partial(self._draw, dim=objective.dim, dtype=state.x.dtype)
        jump, rise, key = draw(state.key)
        more = (1,) * (state.x.ndim - 2)
        low, high = box.bounds(state.x)
        chains = transition(
            state.chains,
            state.hop,
            self.hops,
            jump=(high - low) * jump.reshape(*jump.shape, *more),
            rise=rise.reshape(*rise.shape, *more),
            low=low,
            high=high,
            descend=partial(self._descend, objective, box),
        )
        return _state(state.hop + 1, key, chains)

    def _draw(self, key: jax.Array, dim: int, dtype: np.dtype) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Jump of every chain as a share of the box, (dim, restarts), the rise it accepts, the next key."""
        if self.hops == 0:
            return jnp.zeros((dim, self.restarts), dtype), jnp.zeros(self.restarts, dtype), key
        jump_key, accept_key, key = random.split(key, 3)
        jump = self.hop_size * random.normal(jump_key, (dim, self.restarts), dtype=dtype)
        chance = random.uniform(accept_key, (self.restarts,), dtype=dtype)
        return jump, -self.temperature * jnp.log(chance), key

    def finish(self, objective: Objective, box: Box, state: SearchState) -> Solution:
        """Refine the best point of all chains."""
        lowest, lowest_value = _lowest(state.chains)
        x, value = lowest[:, 0], lowest_value[0]
        if self.refine is not None:
            refined, refined_value = self.refine(objective, box, x)
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
        1 + ``hops`` + ``polish``, or after their rounds. On a GPU, with :class:`ValleySteps` on the
        geometric mean, the steps run in one kernel.
        """
        state = self.init(objective, box, key, starts)
        if state.value[0].size <= _FEW:
            return self.finish(objective, box, self._walk(objective, box, state))
        state = self._advance(objective, box, state, 1)
        if self.hops + self.polish > 0:
            state = self._go_on(objective, box, state)
        return self.finish(objective, box, state)

    @property
    def _most_rounds(self) -> int:
        """Times that an open problem takes ``hops`` + ``polish`` steps."""
        return max(1, self.rounds) if self.hops + self.polish > 0 else 0

    def _walk(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """All steps of a few problems, in one loop that compiles the step once."""
        key = self._draw(state.key, objective.dim, state.x.dtype)[2]  # after the first minimization
        begin = partial(self._begin_round, objective, box, key)

        def goes_on(carry: tuple[SearchState, Chains, jax.Array, jax.Array]) -> jax.Array:
            _, _, ended, is_open = carry
            return (ended <= self._most_rounds) & jnp.any(is_open)

        def advance(
            carry: tuple[SearchState, Chains, jax.Array, jax.Array],
        ) -> tuple[SearchState, Chains, jax.Array, jax.Array]:
            before, ends, ended, is_open = carry
            after = self.step(objective, box, before)
            state = _state(after.hop, after.key, _where(is_open, after.chains, before.chains))
            first = ended == 0
            # the first round begins after the first minimization, the others with one
            last = self.hops + self.polish + (ended == 1).astype(jnp.int32)
            stops = first | (state.hop == last)
            done = self._have_met(jnp.where(first, state.value, state.best_value))
            ends = _where(ended < 2, state.chains, ends)
            state = lax.cond(stops, begin, lambda state, _: state, state, ended)
            return state, ends, ended + stops.astype(jnp.int32), is_open & ~(stops & done)

        every = jnp.ones(state.value.shape[1:], dtype=bool)
        start = state, state.chains, jnp.zeros((), jnp.int32), every
        state, ends, _, _ = lax.while_loop(goes_on, advance, start)
        return _state(state.hop, state.key, _with_best(ends, state.chains))

    def _advance(self, objective: Objective, box: Box, state: SearchState, count: int) -> SearchState:
        """Make ``count`` steps."""
        state, _ = lax.scan(lambda state, _: (self.step(objective, box, state), None), state, length=count)
        return state

    def _go_on(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """Take the problems that are not settled through their rounds, gathered into full blocks."""
        batch = state.value.shape[1:]
        flat_objective, chains = flatten_problems((objective, state.chains), len(batch))

        def a_round(
            carry: tuple[jax.Array, Chains, Chains, jax.Array], share: int = BLOCK_SHARE
        ) -> tuple[jax.Array, Chains, Chains, jax.Array]:
            number, chains, ends, is_open = carry

            def further(block: tuple[Objective, Chains]) -> Chains:
                objective, chains = block
                start = _state(state.hop, state.key, chains)
                start = self._begin_round(objective, box, state.key, start, number)
                return self._advance(objective, box, start, self.hops + self.polish).chains

            chains = update_marked(further, is_open, (flat_objective, chains), chains, share)
            ends = _where(number == 0, chains, ends)
            return number + 1, chains, ends, is_open & ~self._have_met(chains.best_value)

        def goes_on(carry: tuple[jax.Array, Chains, Chains, jax.Array]) -> jax.Array:
            number, _, _, is_open = carry
            return (number < self._most_rounds) & jnp.any(is_open)

        carry = jnp.zeros((), jnp.int32), chains, chains, ~self._have_met(state.value).reshape(-1)
        share = BLOCK_SHARE
        if jax.default_backend() != "cpu":
            # few problems need more than one round, and an accelerator works on many at once
            carry, share = a_round(carry), _LATER
        _, chains, ends, _ = lax.while_loop(goes_on, partial(a_round, share=share), carry)
        ends = _with_best(ends, chains)
        ends = jax.tree.map(lambda a: a.reshape(*a.shape[:-1], *batch), ends)
        return _state(state.hop, state.key, ends)

    def _begin_round(
        self, objective: Objective, box: Box, key: jax.Array, state: SearchState, number: jax.Array
    ) -> SearchState:
        """The state that a round starts from: for the first, that of the search before.

        Args:
            objective: the problems.
            box: where to search.
            key: of all rounds.
            state: at the end of the first minimization, or of the round before.
            number: () of the round, from 0.
        """
        if self.rounds < 2:
            return state
        afresh = partial(self._begin_afresh, objective, box, key, state, number)
        return lax.cond(number == 0, lambda: state, afresh)

    def _begin_afresh(
        self, objective: Objective, box: Box, key: jax.Array, state: SearchState, number: jax.Array
    ) -> SearchState:
        """One chain at the best point, the others where the data suggest."""
        start_key, key = random.split(random.fold_in(key, number))
        starts = suggested_starts(objective, box, start_key, self.restarts - 1, _CANDIDATES[1])
        x, value = _lowest(state.chains)
        x = jnp.concatenate([x, starts], axis=1)
        value = jnp.concatenate([value, jnp.full(starts.shape[1:], jnp.inf, value.dtype)])
        return _state(jnp.zeros_like(state.hop), key, state.chains._replace(x=x, value=value))

    def _have_met(self, value: jax.Array) -> jax.Array:
        """Whether chains (restarts, ...) all have about the same value, (...). One chain meets nobody."""
        if self.restarts == 1:
            return jnp.zeros(value.shape[1:], dtype=bool)
        return jnp.max(value, axis=0) - jnp.min(value, axis=0) < self.settled

    def _descend(self, objective: Objective, box: Box, x: Coordinates) -> tuple[jax.Array, jax.Array]:
        """Local minimization of every chain: at once if problems are few, else one after the other."""
        starts = cast(jax.Array, x)
        if starts[0].size <= _AT_ONCE:
            chains = repeat_problems(objective, starts.ndim - 2, self.restarts)
            return self.inner(chains, box, starts)
        found, value = lax.map(lambda start: self.inner(objective, box, start), jnp.moveaxis(starts, 1, 0))
        return jnp.moveaxis(found, 0, 1), value
