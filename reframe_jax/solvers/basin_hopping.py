"""Basin hopping: a global search from many starts, for many problems at once.

The starts are points that fill the box evenly, and points derived from the data.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random

from reframe_jax.geometry.small import solve_positive
from reframe_jax.geometry.symmetric import INDEX_PAIRS, PACKED
from reframe_jax.objectives.protocol import MomentsObjective, Objective, check_objective
from reframe_jax.objectives.velocity import FrameObjective
from reframe_jax.solvers.moments_steps import ValleySteps
from reframe_jax.solvers.protocol import Box, LocalMinimiser, Solution, repeat_problems

_SUGGESTED = 0.4  # fraction of the chains with a start from the data, if there are rounds
_CANDIDATES = 4, 64  # candidates per start from the data: in the first round, and in later rounds
_RIDGE = 1e-9  # added curvature, relative to its trace: selects the origin nearest to zero among equal ones


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SearchState:
    """State of a search between two calls of :meth:`BasinHopping.step`.

    Attributes:
        hop: number of completed steps.
        key: JAX random key of the next steps.
        x, value: (dim, restarts, ...) and (restarts, ...), current point of each chain and its value.
        best_x, best_value: (dim, restarts, ...) and (restarts, ...), best point of each chain and its value.
    """

    hop: jax.Array
    key: jax.Array
    x: jax.Array
    value: jax.Array
    best_x: jax.Array
    best_value: jax.Array


_CHAINS = ("x", "value", "best_x", "best_value")
_Carry = tuple[SearchState, jax.Array, jax.Array]  # state, number of complete rounds, problems to continue


@dataclass(frozen=True)
class BasinHopping:
    """Basin hopping (Wales & Doye 1997) from quasi-random starts.

    A chain is a sequence of points from one start. Each chain first minimizes locally. Then, ``hops`` times,
    it jumps, minimizes locally, and accepts the new point if the value is lower or Metropolis' rule accepts
    it. Finally, the chain minimizes ``polish`` more times from its best point. A problem has converged if the
    values of all its chains agree after the first minimization; a converged problem does not hop. All
    problems use the same random numbers, so a result depends on the data and on the key, not on the position
    in a batch.

    With ``rounds``, some chains start at points derived from the data (:func:`suggested_starts`). A problem
    whose chains do not agree starts another round: one chain continues from the best point, and the other
    chains start at new points derived from the data. Slow motion needs rounds, because its objective has many
    narrow valleys.

    :meth:`minimise` runs the whole search. To observe a search or to stop it early, call ``init``, then
    ``step`` 1 + ``hops`` + ``polish`` times, then ``finish``. These three methods are pure functions of
    arrays and can be compiled. They have no rounds, and converged problems take all steps too.

    Attributes:
        inner: local minimizer: :class:`ValleySteps`, :class:`FrameSteps`, or any :data:`LocalMinimiser`.
        restarts: number of chains per problem.
        hops: number of jumps per chain.
        polish: number of final minimizations per chain, without a jump.
        refine: another local minimizer, for the best point of all chains; None for no refinement.
        hop_size: standard deviation of a jump, as a fraction of the width of the box.
        temperature: temperature of Metropolis' rule, in units of the value. For a norm J, the value is log J:
            a temperature of 0.1 accepts a norm that is 10 % larger with probability 1/e.
        tolerance: largest difference between the values of the chains of a converged problem; with 0, every
            problem hops.
        rounds: largest number of rounds per problem; with 0, there is one round, and all its starts are
            quasi-random.
    """

    inner: LocalMinimiser
    restarts: int = 8
    hops: int = 2
    polish: int = 1
    refine: LocalMinimiser | None = None
    hop_size: float = 0.1
    temperature: float = 0.1
    tolerance: float = 1e-4
    rounds: int = 0

    def init(self, objective: Objective, box: Box, key: jax.Array) -> SearchState:
        """Return the initial state, with the starts of all chains and infinite values.

        The starts are quasi-random points, equal for all problems; with ``rounds``, also points derived from
        the data.

        Args:
            objective: the problems.
            box: bounds of the search.
            key: JAX random key.

        Raises:
            ValueError: if the objective is not an :class:`Objective`.
        """
        check_objective(objective)
        seed_key, key = random.split(key)
        suggested = round(_SUGGESTED * self.restarts) if self.rounds else 0
        x = even_starts(objective, box, seed_key, self.restarts - suggested)
        if suggested:
            more = suggested_starts(objective, box, random.fold_in(seed_key, 1), suggested, _CANDIDATES[0])
            x = jnp.concatenate([x, more], axis=1)
        value = jnp.full(x.shape[1:], jnp.inf, dtype=objective.dtype)
        return SearchState(jnp.zeros((), jnp.int32), key, x, value, x, value)

    def step(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """Advance every chain by one step: jump, minimize, and accept or reject the new point.

        The first step minimizes the starts without a jump. Steps after the last hop minimize the best points.
        A value of NaN counts as infinite. Arguments as in :meth:`init`, and the state before the step.
        """
        key, dtype = state.key, state.x.dtype
        jump, rise = jnp.zeros((objective.dim, self.restarts), dtype), jnp.zeros(self.restarts, dtype)
        if self.hops:
            jump_key, accept_key, key = random.split(key, 3)
            jump = self.hop_size * random.normal(jump_key, jump.shape, dtype=dtype)
            rise = -self.temperature * jnp.log(random.uniform(accept_key, rise.shape, dtype=dtype))
        more = (1,) * (state.x.ndim - 2)
        low, high = box.bounds(state.x)
        moved = jnp.clip(state.x + (high - low) * jump.reshape(*jump.shape, *more), low, high)
        start = jnp.where(state.hop > self.hops, state.best_x, moved)
        start = jnp.where(state.hop == 0, state.x, start)
        x, value = self.inner(repeat_problems(objective, len(more), self.restarts), box, start)
        value = jnp.where(jnp.isnan(value), jnp.inf, value)
        accept = value < state.value + rise.reshape(-1, *more)
        better = value < state.best_value
        return SearchState(
            state.hop + 1,
            key,
            jnp.where(accept[None], x, state.x),
            jnp.where(accept, value, state.value),
            jnp.where(better[None], x, state.best_x),
            jnp.where(better, value, state.best_value),
        )

    def finish(self, objective: Objective, box: Box, state: SearchState) -> Solution:
        """Refine the best point of the chains of every problem, and return the solution."""
        lowest, lowest_value = _lowest(state)
        x, value = lowest[:, 0], lowest_value[0]
        if self.refine is not None:
            refined, refined_value = self.refine(objective, box, x)
            better = refined_value < value
            x, value = jnp.where(better[None], refined, x), jnp.where(better, refined_value, value)
        close = state.best_value < value[None] + 1e-3
        return Solution(x, value, jnp.mean(close.astype(value.dtype), axis=0))

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Run the whole search: :meth:`init`, :meth:`step` until every problem is done, and :meth:`finish`.

        Arguments and errors as in :meth:`init`. A converged problem is done after one step; the others after
        1 + ``hops`` + ``polish`` steps, in each of their rounds.
        """
        state = self.init(objective, box, key)

        def continues(carry: _Carry) -> jax.Array:
            _, number, is_open = carry
            return (number < max(1, self.rounds)) & jnp.any(is_open)

        def advance(carry: _Carry) -> _Carry:
            before, number, is_open = carry
            after = self.step(objective, box, before)
            first, over = (number == 0) & (after.hop == 1), after.hop == 1 + self.hops + self.polish
            pairs = {name: (getattr(after, name), getattr(before, name)) for name in _CHAINS}
            after = replace(after, **{name: jnp.where(is_open, *pair) for name, pair in pairs.items()})
            value = jnp.where(first, after.value, after.best_value)
            agree = jnp.max(value, axis=0) - jnp.min(value, axis=0) < self.tolerance
            agree = agree & (self.restarts > 1)  # a single chain agrees with no other chain
            if self.rounds > 1:
                after = lax.cond(over, lambda s: self._start_round(objective, box, s), lambda s: s, after)
            return after, number + over.astype(jnp.int32), is_open & ~((first | over) & agree)

        every = jnp.ones(state.value.shape[1:], bool)
        state, _, _ = lax.while_loop(continues, advance, (state, jnp.zeros((), jnp.int32), every))
        return self.finish(objective, box, state)

    def _start_round(self, objective: Objective, box: Box, state: SearchState) -> SearchState:
        """Start a round: one chain at the best point, the other chains at points derived from the data."""
        start_key, key = random.split(state.key)
        starts = suggested_starts(objective, box, start_key, self.restarts - 1, _CANDIDATES[1])
        x, value = _lowest(state)
        x = jnp.concatenate([x, starts], axis=1)
        value = jnp.concatenate([value, jnp.full(starts.shape[1:], jnp.inf, value.dtype)])
        return replace(state, hop=jnp.zeros_like(state.hop), key=key, x=x, value=value)


def _lowest(state: SearchState) -> tuple[jax.Array, jax.Array]:
    """Best point of all chains, (dim, 1, ...), and its value, (1, ...)."""
    best = jnp.argmin(state.best_value, axis=0)[None]
    x = jnp.take_along_axis(state.best_x, best[None], axis=1)
    return x, jnp.take_along_axis(state.best_value, best, axis=0)


@dataclass(frozen=True)
class JointSearch:
    """Global search of a :class:`PositionObjective`, over the :class:`FrameObjective` with the same moments.

    With a negative exponent, the axis with the least motion dominates the norm. The norm then has many narrow
    minima over the origin, and a chain over origins ends in the nearest minimum. Chains over orientation and
    origin start with different axes and reach different minima, so they miss fewer optima in less time.

    Attributes:
        search: global search over orientation and origin, with :class:`FrameSteps` as local minimizer.
        refine: local minimizer for the origin of the best frame.
    """

    search: BasinHopping
    refine: ValleySteps

    def minimise(self, objective: Objective, box: Box, key: jax.Array) -> Solution:
        """Search every problem of the objective.

        Raises:
            ValueError: unless :class:`ValleySteps` can minimize the objective.
        """
        known = self.refine.check(objective)
        turn = jnp.full_like(box.low, jnp.pi)
        frames = Box(jnp.concatenate([-turn, box.low]), jnp.concatenate([turn, box.high]))
        found = self.search.minimise(FrameObjective(known.moments, known.exponent), frames, key)
        x, value = self.refine(objective, box, found.x[3:])
        return Solution(x, value, found.agreement)


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
    d = random.normal(key, (3, candidates * count), dtype).reshape(3, -1, *([1] * len(batch)))
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
