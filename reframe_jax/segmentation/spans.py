"""What every span of a recording costs, if one constraint holds in it."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import compiler_options, once
from reframe_jax.constraints.types import POSITION_BODIES, AngularType
from reframe_jax.geometry import symmetric
from reframe_jax.objectives.moments import covariance_at, covariance_hessian
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.segmentation.blocks import Blocks
from reframe_jax.solvers import Box, ValleySteps

__all__ = ["LONGEST", "Fits", "fit_spans", "span_costs"]

LONGEST = 64  # blocks in a span, at most
_STARTS = 256  # spans of one length computed at once
_STEPS = 3, 3, 4  # of the search: from the origins of the two spans within a span, and from its centre
_SEGMENTS = 32  # spans fitted at once
_STEPS_ALONE = 12  # of the search of one fit, from each of these points of a cube
_CORNERS = np.array([(0, 0, 0), *np.ndindex(2, 2, 2)]) * 2 - np.array([(0, 0, 0), *[(1, 1, 1)] * 8])
_ON_BODY = POSITION_BODIES == AngularType.B  # the origin is fixed in {b}


class Totals(NamedTuple):
    """Sums over the chords of spans, see :class:`Blocks`; the last axis is over spans."""

    angular: jax.Array
    linear: jax.Array
    sums: jax.Array
    moving: jax.Array


@dataclass(frozen=True)
class Fits:
    """The best frames of spans.

    Attributes:
        cost: (S,) nats.
        angular_type, linear_type: (S,) of the lowest cost.
        angular_axes, linear_axes: (S, 3, 3), columns are axes in the bodies of the types.
        position: (S, 3) m, origin of the linear frame; about the recording's centre for types in the ground.
    """

    cost: np.ndarray
    angular_type: np.ndarray
    linear_type: np.ndarray
    angular_axes: np.ndarray
    linear_axes: np.ndarray
    position: np.ndarray


def fit_spans(blocks: Blocks, spans: list[list[tuple[int, int]]], noise_ratio: float, reach: float) -> Fits:
    """Fit a constraint to each of several spans, or to several spans at once.

    Args:
        blocks: of the recording.
        spans: of each fit one or more (first block, first behind).
        noise_ratio: as in :func:`span_costs`.
        reach: as in :func:`span_costs`.
    """
    parts = (blocks.angular, blocks.linear, blocks.sums)

    def total(x: np.ndarray, pieces: list[tuple[int, int]]) -> np.ndarray:
        return sum(np.sum(x[0][..., a:b], -1) + np.sum(x[1][..., a : b - 1], -1) for a, b in pieces)

    sums = [np.stack([total(x, pieces) for pieces in spans], axis=-1) for x in parts]
    moving = np.array([sum(np.sum(blocks.moving[a:b]) for a, b in pieces) for pieces in spans])
    found = []
    for first in range(0, len(spans), _SEGMENTS):
        own = np.minimum(np.arange(first, first + _SEGMENTS), len(spans) - 1)
        found.append(
            jax.device_get(
                _fits(Totals(*(jnp.asarray(x[..., own]) for x in (*sums, moving))), noise_ratio, reach)
            )
        )
    return Fits(*(np.concatenate(x)[: len(spans)] for x in zip(*found, strict=True)))


@functools.partial(jax.jit, compiler_options=compiler_options())
def _fits(total: Totals, noise_ratio: Any, reach: Any) -> tuple[jax.Array, ...]:
    means = _means(total)
    objective, box = _problem(means, reach)
    starts = means.centre[None] + reach / 2 * jnp.asarray(_CORNERS, means.centre.dtype)[..., None, None]
    found, values = jax.vmap(lambda start: ValleySteps(_STEPS_ALONE)(objective, box, start))(starts)
    best = jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values), axis=0)
    p = jnp.take_along_axis(found, best[None, None], axis=0)[0]
    p = jnp.where(jnp.isnan(p), means.centre, p)  # where the body rests, no step leads anywhere
    turning, sliding, turning_axes, axes = _costs_of_types(means, p, noise_ratio, reach)
    kinds = jnp.argmin(turning, axis=0), jnp.argmin(sliding, axis=0)

    def columns(frames: Any, kind: jax.Array) -> jax.Array:
        array = jnp.stack([jnp.stack(axis) for axis in frames], axis=1)  # (3, 3, types, S)
        return jnp.moveaxis(jnp.take_along_axis(array, kind[None, None, None], axis=2)[:, :, 0], -1, 0)

    position = jnp.take_along_axis(p, kinds[1][None, None], axis=1)[:, 0].T
    cost = _either(turning) + _either(sliding) + means.alone
    return cost, *kinds, columns(turning_axes, kinds[0]), columns(axes, kinds[1]), position


def span_costs(blocks: Blocks, noise_ratio: float, reach: float) -> np.ndarray:
    """Cost of every span of up to :data:`LONGEST` blocks, in nats.

    Args:
        blocks: M of the recording.
        noise_ratio: 1/m, standard deviation of orientation (rad) over that of position (m).
        reach: m, half the width of the cube in which origins are searched.

    Returns:
        (M, LONGEST): at [i, w] of the span of blocks i to i + w; infinite beyond the end.
    """
    number = len(blocks.moving)
    costs = np.full((number, LONGEST), np.inf)
    parts = (blocks.angular, blocks.linear, blocks.sums, blocks.moving)

    def compute(first: int) -> None:
        here = min(number - first, _STARTS + LONGEST)
        fill = _STARTS + LONGEST - here
        own = [np.pad(x[..., first : first + here], [(0, 0)] * (x.ndim - 1) + [(0, fill)]) for x in parts]
        with jax.enable_x64(True):  # JAX's settings belong to a thread
            found = np.asarray(_costs(*own, noise_ratio, reach)).T
        costs[first : first + _STARTS] = found[: min(_STARTS, number - first)]

    firsts = range(0, number, _STARTS)
    compute(firsts[0])  # two threads would both compile
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(compute, firsts[1:]))
    i, w = np.indices(costs.shape)
    return np.where(i + w < number, costs, np.inf)


@functools.partial(jax.jit, compiler_options=compiler_options())
def _costs(
    angular: jax.Array, linear: jax.Array, sums: jax.Array, moving: jax.Array, noise_ratio: Any, reach: Any
) -> jax.Array:
    """(LONGEST, _STARTS)."""

    def part(x: jax.Array, offset: jax.Array) -> jax.Array:
        return jax.lax.dynamic_slice_in_dim(x, offset, _STARTS, axis=-1)

    def step(carry: tuple[Totals, jax.Array], w: jax.Array) -> tuple[tuple[Totals, jax.Array], jax.Array]:
        before, p = carry
        further = (w > 0).astype(moving.dtype)
        added = (part(x[0], w) + part(x[1], jnp.maximum(w - 1, 0)) * further for x in (angular, linear, sums))
        own = Totals(*(a + b for a, b in zip(before, (*added, part(moving, w)), strict=True)))
        own = once(own)
        cost, p = cost_of(own, p, noise_ratio, reach)
        return (own, p), cost

    zero = Totals(
        *(jnp.zeros_like(part(x, jnp.asarray(0))) for x in (angular[0], linear[0], sums[0], moving))
    )
    start = jnp.zeros((3, 4, _STARTS), linear.dtype)
    return jax.lax.scan(step, (zero, start), jnp.arange(LONGEST))[1]


def cost_of(
    total: Totals, p: jax.Array, noise_ratio: jax.Array, reach: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Cost of spans, (M,), and where the origins of the best frames lie, (3, 4, M)."""
    means = _means(total)
    p = _search(means, p, reach)
    turning, sliding, _, _ = _costs_of_types(means, p, noise_ratio, reach)
    return _either(turning) + _either(sliding) + means.alone, p


class _Means(NamedTuple):
    """Means over the chords of spans, and what the search needs.

    Attributes:
        angular, linear: second moments.
        floors, logs: (2, M) mean noise variance of both groups, and the smallest variance that can be told.
        scatter: (M,) m^2, of the positions of {b}.
        centre: (3, 4, M) m, where origins are likeliest.
        motions: (M,) independent motions.
        alone: (M,) infinite for spans that move but hold no chord, else zero.
    """

    angular: jax.Array
    linear: jax.Array
    floors: jax.Array
    logs: jax.Array
    scatter: jax.Array
    centre: jax.Array
    motions: jax.Array
    alone: jax.Array


def _means(total: Totals) -> _Means:
    number = jnp.maximum(total.sums[0], 1)
    rests = total.sums[0] == 0
    unit = jnp.asarray([1, 0, 0, 1, 0, 1], number.dtype)[:, None, None]
    identity = jnp.pad(unit[:, None], ((0, 0), (0, 9), (0, 0), (0, 0)))
    mean = total.sums[5:8] / number[None]
    squares = jnp.where(rests, 0, total.sums[8] / number - jnp.sum(mean**2, axis=0))
    # the variance that noise happens to have in so many chords (its differences, 2 chords in 3 independent)
    scatter = total.sums[1:3] / number[None] * jnp.minimum(jnp.sqrt(3 / number), 1)[None]
    return _Means(
        angular=jnp.where(rests[None, None], unit, total.angular / number[None, None]),
        linear=jnp.where(rests[None, None, None], identity, total.linear / number[None, None, None]),
        floors=jnp.where(rests[None], 1, total.sums[1:3] / number[None]),
        logs=jnp.maximum(jnp.exp(total.sums[3:5] / number[None]), scatter),
        scatter=jnp.maximum(squares, 0),
        centre=jnp.where(jnp.asarray(_ON_BODY)[None, :, None], 0, mean[:, None]),
        motions=jnp.where(rests, 0, total.moving),
        alone=jnp.where(rests & (total.moving > 0), jnp.inf, 0),
    )


def _either(costs: jax.Array) -> jax.Array:
    """Cost if any of the frame types may hold, each as likely as the others."""
    return -jax.nn.logsumexp(-costs, axis=0) + jnp.log(float(len(costs)))


def _costs_of_types(means: _Means, p: jax.Array, noise_ratio: Any, reach: Any) -> tuple[Any, ...]:
    """Cost of the angular types, (2, M), and of the linear ones, (4, M), and the axes of both."""
    n = means.motions[None]
    turning, _, turning_axes = _parts(means.angular, means.floors[0][None], means.logs[0][None], n)
    ground = jnp.asarray(~_ON_BODY, p.dtype)[:, None]
    lever = jnp.sum(jnp.square(p - means.centre), axis=0) + ground * means.scatter[None]
    more = 1 + noise_ratio**2 * lever
    sigma = jnp.stack(covariance_at(means.linear, (p[0], p[1], p[2])))
    linear, weights, axes = _parts(sigma, means.floors[1][None] * more, means.logs[1][None] * more, n)
    return turning, linear + _position_cost(means.linear, weights, n, reach), turning_axes, axes


def _problem(means: _Means, reach: Any) -> tuple[PositionObjective, Box]:
    moments = means.linear.at[jnp.asarray([0, 3, 5]), 0].add(means.floors[1][None, None])
    return PositionObjective(moments), Box(means.centre - reach, means.centre + reach)


def _search(means: _Means, p: jax.Array, reach: jax.Array) -> jax.Array:
    """Origins (3, 4, M), from those of the spans that are one block shorter."""
    objective, box = _problem(means, reach)
    best, value = means.centre, jnp.full(p.shape[1:], jnp.inf, p.dtype)
    for start, steps in zip((p, jnp.roll(p, -1, axis=-1), means.centre), _STEPS, strict=True):
        x, level = ValleySteps(steps)(objective, box, box.clip(start))
        best, value = jnp.where((level < value)[None], x, best), jnp.minimum(level, value)
    return best


def _parts(sigma: jax.Array, floor: jax.Array, log_floor: jax.Array, n: jax.Array) -> Any:
    """Cost of velocities of covariance (6, types, M), the inverse of the covariance, and its axes."""
    values, axes = symmetric.eigh(tuple(sigma))  # type: ignore[arg-type]
    v = [jnp.maximum(x - floor, 0) + log_floor for x in values]
    data = n / 2 * (jnp.log(v[0]) + jnp.log(v[1]) + jnp.log(v[2]))
    turns = (
        sum(jnp.log1p(n * jnp.square(v[i] - v[j]) / (v[i] * v[j])) for i, j in ((0, 1), (0, 2), (1, 2))) / 2
    )
    inverse = []
    for i, j in symmetric.INDEX_PAIRS:
        inverse.append(sum(axes[k][i] * axes[k][j] / v[k] for k in range(3)))
    return data + turns + 1.5 * jnp.log1p(n / 2), tuple(inverse), axes


def _position_cost(moments: jax.Array, weights: Any, n: jax.Array, reach: jax.Array) -> jax.Array:
    seconds = covariance_hessian(moments)
    information = [n * reach**2 * symmetric.trace_product(weights, s) / 2 for s in seconds]
    for i in (0, 3, 5):
        information[i] = 1 + information[i]
    return jnp.log(jnp.maximum(symmetric.determinant(cast(symmetric.Symmetric, tuple(information))), 1)) / 2
