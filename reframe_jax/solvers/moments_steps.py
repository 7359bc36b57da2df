"""Local minimizers of norms of velocities that are given by moments.

Each iteration tries Newton steps on powers of the norm J, and steps that also work at points distant from
the optimum, and takes the step with the lowest value.

``ValleySteps`` vary the origin p of a frame; the best axes at each origin have a closed form. The value is f
= log J with the velocity covariance Sigma(p); for the geometric mean, f = log det Sigma(p) / 6. Because f is
concave in Sigma, its tangent tr(W(p0) Sigma(p)) with W = df/dSigma bounds f from above. The bound is
quadratic in p, so a 3x3 system gives its minimum. This *majorizing* step is the best step at points distant
from the optimum, and if all three axes are constrained.

``FrameSteps`` vary the orientation and the origin of a frame together. A step rotates the frame about its
axes and shifts its origin, so rotation vectors cause no singularities. With the axes E, the velocity
covariance Sigma at the origin and S = E^T Sigma E, the steps that also work at distant points, tried
together and separately, are:

- *aligning*: rotate by Jacobi's angles, each of which makes one off-diagonal entry of S zero;
- *majorizing*: move the origin to the minimum of sum_n q_n v_n(p) / v_n, where v_n is the variance along
  axis n and q_n its weight in the power mean. This sum bounds log J from above, because J is concave in the
  variances.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations, symmetric
from reframe_jax.geometry.products import matmul
from reframe_jax.geometry.small import rotate
from reframe_jax.objectives.moments import covariance_at
from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective, log_norm
from reframe_jax.solvers.newton_steps import derivatives, steps_in_box, take_best_steps
from reframe_jax.solvers.protocol import BatchSteps, Box

_Frame = tuple[jax.Array, jax.Array]  # axes (3, 3), columns of E, and origin (3,)


class MomentsSteps(BatchSteps):
    """Base of the minimizers of norms that are given by moments."""

    _norm: ClassVar[type[PositionObjective] | type[FrameObjective]]

    def __call__(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Minimize every :class:`MomentsObjective` from starts x, (dim, ...); see :data:`LocalMinimiser`.

        Raises:
            ValueError: for another objective.
        """
        known = self.check(objective)
        found, _ = super().__call__(self._norm(known.moments, known.exponent), box, x)
        return found, objective.value(found)

    @classmethod
    def check(cls, objective: Objective) -> MomentsObjective:
        """Return the objective if these steps can minimize it.

        Raises:
            ValueError: for another objective; the message names a minimizer that works.
        """
        if isinstance(objective, MomentsObjective) and objective.unknowns == cls._norm.unknowns:
            return objective
        raise ValueError(
            f"{cls.__name__} minimize norms given by moments (a {cls._norm.__name__}), not a "
            f"{type(objective).__name__}; NewtonSteps and OptaxSteps minimize any objective."
        )


@dataclass(frozen=True)
class ValleySteps(MomentsSteps):
    """Local minimizer of a :class:`PositionObjective`: the origin of a frame, (3, ...) m.

    Attributes:
        steps: number of steps, equal for all problems of a batch.
    """

    steps: int = 12
    _norm = PositionObjective

    def _minimise_one(self, norm: PositionObjective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def steps_at(x: jax.Array) -> jax.Array:
            gradient, hessian = derivatives(norm.value, x)
            weights = jax.grad(log_norm)(norm.covariance(x), norm.exponent)
            curvature = jax.hessian(lambda x: jnp.sum(jnp.stack(weights) * jnp.stack(norm.covariance(x))))
            down = steps_in_box(x, box.low, box.high, gradient, curvature(x))[:1]
            steps = jnp.concatenate([steps_in_box(x, box.low, box.high, gradient, hessian), down])
            # shorten each step at the box, so that it stays in a narrow valley, and project the last step
            room = jnp.where(steps > 0, (x - box.low)[None], (x - box.high)[None])
            part = jnp.min(jnp.where(steps == 0, 1, room / jnp.where(steps == 0, 1, steps)), axis=1)
            return jnp.concatenate([jnp.minimum(part, 1)[:, None] * steps, down])

        return take_best_steps(x, norm.value, steps_at, lambda x, step: box.clip(x - step), self.steps)


def _aligning_rotation(s: jax.Array) -> jax.Array:
    """Rotation angles about the axes, (3,), each of which makes one off-diagonal entry of S (3, 3) zero."""

    def angle(i: int, j: int) -> jax.Array:
        half, off = (s[j, j] - s[i, i]) / 2, s[i, j]
        tangent = off / (jnp.abs(half) + jnp.hypot(half, off))
        return jnp.arctan(jnp.where(off == 0, 0, jnp.where(half < 0, -tangent, tangent)))

    return jnp.stack([angle(1, 2), -angle(0, 2), angle(0, 1)])


@dataclass(frozen=True)
class FrameSteps(MomentsSteps):
    """Local minimizer of a :class:`FrameObjective`: orientation and origin together, any power mean.

    The unknowns are rotation vectors, rad, and, for linear velocities, origins, m: (dim, ...). The origin
    stays in the box. The orientation is unbounded; the box bounds only its start.

    Attributes:
        steps: number of steps, equal for all problems of a batch.
    """

    steps: int = 10
    _norm = FrameObjective

    def _minimise_one(self, norm: FrameObjective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        free = jnp.full(3, jnp.inf, x.dtype)
        low, high = jnp.concatenate([-free, box.low[3:]]), jnp.concatenate([free, box.high[3:]])

        def along(frame: _Frame) -> jax.Array:
            """S = E^T Sigma E, (3, 3)."""
            axes, origin = frame
            at = tuple(origin) if len(origin) else (0.0, 0.0, 0.0)
            return matmul(axes.T, matmul(symmetric.to_matrix(covariance_at(norm.moments, at)), axes))

        def moved(frame: _Frame, step: jax.Array) -> _Frame:
            return rotate(-step[:3], frame[0].T).T, frame[1] + step[3:]  # E exp(step) to second order

        def level(frame: _Frame) -> jax.Array:
            return log_power_mean(jnp.log(jnp.diagonal(along(frame))) / 2, norm.exponent)

        def steps_at(frame: _Frame) -> jax.Array:
            here = jnp.concatenate([jnp.zeros_like(free), frame[1]])
            gradient, hessian = derivatives(lambda there: level(moved(frame, there - here)), here)
            s = along(frame)
            parts = jax.grad(lambda v: log_power_mean(jnp.log(v) / 2, norm.exponent))(jnp.diagonal(s))
            curvature = jax.hessian(lambda origin: jnp.sum(parts * jnp.diagonal(along((frame[0], origin)))))
            shift = steps_in_box(frame[1], low[3:], high[3:], gradient[3:], curvature(frame[1]))[0]
            turn, still = jnp.zeros_like(here).at[:3].set(_aligning_rotation(s)), jnp.zeros_like(here)
            extra = jnp.stack([turn.at[3:].set(shift), turn, still.at[3:].set(shift)])
            return jnp.concatenate([steps_in_box(here, low, high, gradient, hessian), extra])

        def move(frame: _Frame, step: jax.Array) -> _Frame:
            axes, origin = moved(frame, -step)
            return axes, jnp.clip(origin, low[3:], high[3:])

        start = rotations.rotation_exp(x[:3]), x[3:]
        (axes, origin), value = take_best_steps(start, level, steps_at, move, self.steps)
        return jnp.concatenate([rotations.rotation_log(axes), origin]), value
