"""A local minimizer over the origin of a frame; the best axes at each origin have a closed form.

The value is f = log J as a function of the origin p, with the velocity covariance Sigma(p); for the geometric
mean, f = log det Sigma(p) / 6. Each iteration tries Newton steps on powers of J, and the *majorizing* step.
Because f is concave in Sigma, its tangent tr(W(p0) Sigma(p)) with W = df/dSigma bounds f from above. The
bound is quadratic in p, so a 3x3 system gives its minimum. The majorizing step is the best step at points
distant from the optimum, and if all three axes are constrained.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.objectives.velocity import PositionObjective, log_norm
from reframe_jax.solvers.newton_steps import derivatives, steps_in_box, take_best_steps
from reframe_jax.solvers.protocol import Box, MomentsSteps


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

            def bound(x: jax.Array) -> jax.Array:
                return jnp.sum(jnp.stack(weights) * jnp.stack(norm.covariance(x)))

            down = steps_in_box(x, box.low, box.high, gradient, jax.hessian(bound)(x))[:1]
            steps = jnp.concatenate([steps_in_box(x, box.low, box.high, gradient, hessian), down])
            # shorten each step at the box, so that it stays in a narrow valley, and project the last step
            room = jnp.where(steps > 0, (x - box.low)[None], (x - box.high)[None])
            part = jnp.min(jnp.where(steps == 0, 1, room / jnp.where(steps == 0, 1, steps)), axis=1)
            return jnp.concatenate([jnp.minimum(part, 1)[:, None] * steps, down])

        def move(x: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
            there = jnp.clip(x - step, box.low, box.high)
            return there, norm.value(there)

        return take_best_steps(x, norm.value(x), steps_at, move, self.steps)
