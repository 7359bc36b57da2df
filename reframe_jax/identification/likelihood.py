"""The likeliest frame of a class: what follows once it is known which axes are constrained.

The determinant of all axes finds the type, and which axes are free, without knowing either. Its optimum is
not quite where the constrained axes are most at rest: the variances of free axes depend on the origin too,
and so does the noise, because that of the orientation acts through the lever to the origin. With the class
known, both are left out: the likelihood takes the constrained axes alone, from moments without that noise.
"""

from dataclasses import dataclass, replace

import jax
import numpy as np

from reframe_jax.arrays import jnp, lax, vmap
from reframe_jax.compilation import once
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric
from reframe_jax.identification.classify import nearest_origin
from reframe_jax.identification.evidence import Evidence
from reframe_jax.identification.levers import noise_moments
from reframe_jax.identification.optima import Frames, Optima, follow_last, pick_problem, pick_type
from reframe_jax.identification.shared_axis import axis_of_rotation, slides_along_axis
from reframe_jax.motion.components import product
from reframe_jax.objectives.held_axes import HeldAxesObjective
from reframe_jax.objectives.moments import add_covariance, add_variance, covariance_at
from reframe_jax.objectives.norms import principal_axes
from reframe_jax.solvers import Box
from reframe_jax.solvers.implicit import attach_derivative
from reframe_jax.solvers.problems import repeat_problems

__all__ = ["likeliest_frames"]

_STEPS = 4
_LENGTHS = 1.0, 0.3, 3.0  # of Newton's step that are tried
_PRIOR = 1.0  # m, how far from the start an origin is expected that the data leave open


def likeliest_frames(
    evidence: Evidence,
    frames: Frames,
    optima: Optima,
    dof: tuple[jax.Array, jax.Array],
    idle: jax.Array,
    chosen: jax.Array,
) -> Frames:
    """The frames, those of the best linear type replaced by the likeliest ones.

    Args:
        evidence: of N windows.
        frames: of all types.
        optima: from which they come.
        dof: degrees of freedom, (N, 2, 3) and (N, 4, 3).
        idle: (N,) rad/s, RMS of what counts as no rotation.
        chosen: (N,) bool, windows whose noise is white; the frames of others stay as they are.
    """
    winner = optima.linear_winner
    held = 1 - pick_type(dof[1], winner).T
    slides = pick_type(slides_along_axis(evidence, frames, dof, chosen), winner)
    chosen = chosen & (jnp.sum(held, axis=0) > 0)

    def free() -> jax.Array:
        velocities = pick_problem(winner, optima.objective.moments)
        axes, rms, position = (pick_type(a, winner) for a in (frames.local_axes, optima.rms, frames.position))
        return lax.stop_gradient(nearest_origin(velocities, axes, 1 - held.T, rms, position, idle)[0])

    def fit(_: None) -> tuple[jax.Array, jax.Array]:
        start = follow_last(chosen, pick_type(frames.position, winner).T)
        spread, noise = (
            follow_last(chosen, pick_problem(winner, moments))
            for moments in (evidence.linear_spread, noise_moments(evidence))
        )
        # its mean is left in, so that what remains along every axis is positive
        mean = symmetric.trace(covariance_at(noise, (start[0], start[1], start[2]))) / 3
        moments = add_variance(spread - noise, mean)
        objective = once(HeldAxesObjective(moments, held.astype(moments.dtype)))
        stiff = once(_with_rotations(evidence, winner, slides, objective, start))
        inside = jax.tree.map(lambda bound: pick_problem(winner, bound), optima.box)
        samples = evidence.poses.astype(moments.dtype)
        loose = jnp.moveaxis(free(), 0, -1)
        problem = _Tied(stiff, start, loose, 2 / (samples * _PRIOR**2))
        x = _descend(lax.stop_gradient(problem), inside)
        x = attach_derivative(x, problem, inside)
        return x.T, principal_axes(objective.covariance(x))[1]

    def keep(_: None) -> tuple[jax.Array, jax.Array]:
        return pick_type(frames.position, winner), pick_type(frames.axes, winner)

    position, axes = lax.cond(jnp.any(chosen), fit, keep, None)
    here = chosen[:, None] & (winner[:, None] == jnp.arange(4, dtype=winner.dtype)[None])
    return replace(
        frames,
        position=jnp.where(here[..., None], position[:, None], frames.position),
        axes=jnp.where(here[..., None, None], axes[:, None], frames.axes),
        local_axes=jnp.where(here[..., None, None], axes[:, None], frames.local_axes),
    )


def _with_rotations(
    evidence: Evidence, winner: jax.Array, slides: jax.Array, objective: HeldAxesObjective, start: jax.Array
) -> HeldAxesObjective:
    """The likelihood with what the rotations know of the free axis, where the body slides along it.

    A tilt d of the axis adds v n s^2 / r^2 d^2 to the variance v across it.
    """
    axis = follow_last(slides, pick_type(axis_of_rotation(evidence), winner).T)
    across = symmetric.eigh(objective.covariance(start))[0][:2]
    variance = follow_last(slides, (across[0] + across[1]) / 2 * evidence.axis.spread)
    noise = jnp.where(slides, evidence.share * evidence.noise.rotation, 1)
    stiffness = jnp.where(slides, variance / jnp.square(noise), 0)
    pairs = jnp.stack([axis[i] * axis[j] for i, j in INDEX_PAIRS])
    return replace(objective, moments=add_covariance(objective.moments, stiffness[None] * pairs))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Tied:
    """The likelihood with a prior about a start, at which the origin stays in the directions that are free.

    Attributes:
        held: the likelihood.
        start: (3, ...) m.
        free: (3, 3, ...) projectors.
        prior: (...) 1/m^2, which keeps origins near where the data hardly tell them.
    """

    held: HeldAxesObjective
    start: jax.Array
    free: jax.Array
    prior: jax.Array

    @property
    def dim(self) -> int:
        return self.held.dim

    @property
    def batch(self) -> tuple[int, ...]:
        return self.held.batch

    @property
    def dtype(self) -> np.dtype:
        return self.held.dtype

    def value(self, x: jax.Array) -> jax.Array:
        away = x - self.start
        there = x - product(self.free, away)
        return self.held.value(there) + self.prior * jnp.sum(jnp.square(away), axis=0) / 2


def _descend(problem: _Tied, box: Box) -> jax.Array:
    """A few of Newton's steps from the starts, each as far as it helps; the origins, (3, N)."""
    start, prior = problem.start, problem.prior
    tied = jnp.eye(3, dtype=start.dtype)[:, :, None] - problem.free

    def step(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        x, best = carry
        slope, curvature = problem.held.slope_and_curvature(x)
        slope = product(tied, slope + prior[None] * (x - start))
        strengths, axes = symmetric.eigh(_restrict(tied, curvature, prior))
        down = jnp.zeros_like(x)
        for strength, axis in zip(strengths, axes, strict=True):
            along = jnp.stack(axis)
            share = jnp.sum(along * slope, axis=0) / jnp.maximum(jnp.abs(strength), prior)
            down = down - share[None] * along
        lengths = jnp.asarray(_LENGTHS, x.dtype)
        tried = once(vmap(lambda length: box.clip(x + length * down), out_axes=1)(lengths))
        found = once(repeat_problems(problem, 1, len(_LENGTHS)).value(tried))
        shortest = jnp.argmin(found, axis=0)[None]
        there = jnp.take_along_axis(tried, shortest[None], axis=1)[:, 0]
        lowest = jnp.take_along_axis(found, shortest, axis=0)[0]
        better = lowest < best
        return jnp.where(better[None], there, x), jnp.where(better, lowest, best)

    return lax.fori_loop(0, _STEPS, step, (start, problem.value(start)))[0]


def _restrict(tied: jax.Array, curvature: Symmetric, prior: jax.Array) -> Symmetric:
    """The curvature in the directions that are not free, and the prior in all."""
    xx, xy, xz, yy, yz, zz = curvature
    matrix = jnp.stack([jnp.stack(row) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])
    inside = product(product(tied, matrix), tied)
    a, b, c, d, e, f = (inside[i, j] for i, j in INDEX_PAIRS)
    return a + prior, b, c, d + prior, e, f + prior
