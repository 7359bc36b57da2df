"""Local steps for the position of a frame that do not stall in narrow valleys.

With the rotation eliminated, f(p) = log det Sigma(p) near an optimum of a window with little noise is
the logarithm of a small number: a narrow, curved, concave-sided funnel, in which Newton's method on f
diverges and gradient descent crawls. Each step here evaluates a few candidates and keeps the best, so
f never rises:

- *majorise-minimise*: log det is concave, so tr(Sigma(p0)^-1 Sigma(p)) bounds it from above; the
  bound is quadratic and its minimum one 3x3 solve. Best far from the optimum and where all three axes
  are constrained.
- *Newton on det^(1/m)*, m = 1, 2, 3 and on log det: where m axes are constrained, det behaves as the
  m-th power of a quadratic, and the step for that m is exact. All four share one direction,
  d = H^-1 g of log det, and differ in length only: 1 / (1 + g.d / m). In a funnel g.d < 0 and the sign
  turns, which is why no damping is needed.

Coordinates on a face of the box whose gradient points outwards are held there, and the step is taken
in the others.
"""

from dataclasses import dataclass
from typing import cast

import jax
import jax.numpy as jnp

from reframe_jax import symmetric
from reframe_jax.compilation import once
from reframe_jax.moments import MONOMIALS, covariance_at, covariance_gradient
from reframe_jax.objectives import PositionObjective
from reframe_jax.optimise.box import Box
from reframe_jax.symmetric import INDEX_PAIRS, Symmetric, Vector

__all__ = ["ValleySteps", "derivatives"]

_QUADRATIC = {pair: MONOMIALS.index((pair[0] + 1, pair[1] + 1)) for pair in INDEX_PAIRS}
_RIDGE = 1e-10  # of the Hessians, relative to the trace: keeps a free direction solvable


def derivatives(moments: jax.Array, p: Vector) -> tuple[Vector, Symmetric, Symmetric]:
    """Gradient, majorising curvature and Hessian of log det Sigma(p).

    With W = Sigma^-1: g_a = tr(W Sigma_a), A_ab = tr(W Sigma_ab), H_ab = A_ab - tr(W Sigma_a W Sigma_b).
    """
    sigma = once(covariance_at(moments, p))
    scale = 1 / symmetric.determinant(sigma)
    w = cast(Symmetric, tuple(scale * c for c in symmetric.adjugate(sigma)))
    w, slopes = once((w, covariance_gradient(moments, p)))
    gradient = cast(Vector, tuple(symmetric.trace_product(w, slope) for slope in slopes))
    products = [_product(w, slope) for slope in slopes]
    curvature, hessian = [], []
    for a, b in INDEX_PAIRS:
        column = moments[:, _QUADRATIC[a, b]]
        second = cast(Symmetric, tuple(column[i] for i in range(6)))
        majorant = (2.0 if a == b else 1.0) * symmetric.trace_product(w, second)
        coupling = sum(products[a][i][j] * products[b][j][i] for i in range(3) for j in range(3))
        curvature.append(majorant)
        hessian.append(majorant - coupling)
    return once((gradient, cast(Symmetric, tuple(curvature)), cast(Symmetric, tuple(hessian))))


def _product(a: Symmetric, b: Symmetric) -> list[list[jax.Array]]:
    axx, axy, axz, ayy, ayz, azz = a
    bxx, bxy, bxz, byy, byz, bzz = b
    left = ((axx, axy, axz), (axy, ayy, ayz), (axz, ayz, azz))
    right = ((bxx, bxy, bxz), (bxy, byy, byz), (bxz, byz, bzz))
    return [
        [sum((left[i][k] * right[k][j] for k in range(3)), jnp.zeros_like(axx)) for j in range(3)]
        for i in range(3)
    ]


def _hold(matrix: Symmetric, held: list[jax.Array], trace: jax.Array) -> Symmetric:
    """The matrix with the rows and columns of held coordinates made diagonal, and a small ridge."""
    entries = []
    for (a, b), entry in zip(INDEX_PAIRS, matrix, strict=True):
        if a == b:
            entries.append(jnp.where(held[a], trace, entry + _RIDGE * trace))
        else:
            entries.append(jnp.where(held[a] | held[b], 0, entry))
    return cast(Symmetric, tuple(entries))


def _room(p: Vector, direction: Vector, low: jax.Array, high: jax.Array) -> jax.Array:
    """Largest length up to 1 for which p - length * direction stays in the box."""
    length = jnp.ones_like(p[0])
    for i in range(3):
        room = jnp.where(direction[i] > 0, p[i] - low[i], p[i] - high[i])
        inside = jnp.where(direction[i] == 0, 1, room / jnp.where(direction[i] == 0, 1, direction[i]))
        length = jnp.minimum(length, inside)
    return length


@dataclass(frozen=True)
class ValleySteps:
    """Local minimiser of a :class:`PositionObjective`.

    Attributes:
        steps: number of steps; fixed, so that no problem waits for another.
    """

    steps: int = 12

    def __call__(self, objective: PositionObjective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Improve the origins x, (3, ...).

        Returns:
            The new origins and their values, (...).

        Raises:
            ValueError: for another objective or another exponent.
        """
        if not isinstance(objective, PositionObjective) or objective.exponent != 0:
            raise ValueError(
                "ValleySteps minimise the geometric mean over positions (a PositionObjective of exponent "
                "0); use NewtonSteps or OptaxSteps for other objectives."
            )
        moments = objective.moments
        low, high = box.bounds(x)

        def determinant(p: Vector) -> jax.Array:
            det = symmetric.determinant(covariance_at(moments, p))
            return jnp.where(det > 0, det, jnp.inf)  # rounding, not a better point

        def step(carry: tuple[Vector, jax.Array], _: None) -> tuple[tuple[Vector, jax.Array], None]:
            p, best = carry
            gradient, curvature, hessian = derivatives(moments, p)
            held = [
                ((p[i] <= low[i]) & (gradient[i] > 0)) | ((p[i] >= high[i]) & (gradient[i] < 0))
                for i in range(3)
            ]
            g = cast(Vector, tuple(jnp.where(held[i], 0, gradient[i]) for i in range(3)))
            trace = curvature[0] + curvature[3] + curvature[5]
            down = symmetric.solve(_hold(curvature, held, trace), g)
            newton = symmetric.solve(_hold(hessian, held, trace), g)
            down, newton = once((down, newton))
            slope = sum((newton[i] * g[i] for i in range(3)), jnp.zeros_like(best))
            chosen = p
            lengths = [1 / (1 + slope / m) for m in (1.0, 2.0, 3.0)]
            room, lengths = once((_room(p, down, low, high), lengths))
            candidates = [(down, room), (down, jnp.ones_like(best))]
            candidates += [(newton, length) for length in (jnp.ones_like(best), *lengths)]
            for direction, length in candidates:
                trial = cast(
                    Vector,
                    tuple(jnp.clip(p[i] - length * direction[i], low[i], high[i]) for i in range(3)),
                )
                trial = once(trial)
                value = once(determinant(trial))
                better = value < best  # false for NaN
                best = jnp.where(better, value, best)
                chosen = cast(Vector, tuple(jnp.where(better, trial[i], chosen[i]) for i in range(3)))
                best, chosen = once((best, chosen))
            return (chosen, best), None

        start: Vector = (x[0], x[1], x[2])
        (p, _), _ = jax.lax.scan(step, (start, determinant(start)), length=self.steps)
        found = jnp.stack(p)
        return found, objective.value(found)
