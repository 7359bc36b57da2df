"""Local steps for the position of a frame that do not stall in narrow valleys.

With the rotation eliminated, f(p) = log det Sigma(p) near an optimum of a window with little noise is
the logarithm of a small number: a narrow, curved, concave-sided funnel, in which Newton's method on f
diverges and gradient descent crawls. Each step here evaluates a few candidates and keeps the best, so
f never rises but for rounding:

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
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from reframe_jax import symmetric
from reframe_jax.compilation import once
from reframe_jax.moments import MONOMIALS, covariance_at, covariance_gradient
from reframe_jax.objectives import PositionObjective
from reframe_jax.optimise.box import Box
from reframe_jax.symmetric import INDEX_PAIRS, Symmetric, Vector

__all__ = ["ValleySteps"]

_QUADRATIC = {pair: MONOMIALS.index((pair[0] + 1, pair[1] + 1)) for pair in INDEX_PAIRS}
_RIDGE = 1e-10  # of the Hessians, relative to the trace: keeps a free direction solvable


class _Expansion(NamedTuple):
    """Derivatives of log det Sigma at a point.

    With W = Sigma^-1 and Sigma_a, Sigma_ab the derivatives of Sigma,
    g_a = tr(W Sigma_a), A_ab = tr(W Sigma_ab), H_ab = A_ab - tr(W Sigma_a W Sigma_b).
    """

    sigma: Symmetric
    slopes: tuple[Symmetric, ...]  # Sigma_a
    gradient: Vector
    majorant: Symmetric  # A, the curvature of the majorising quadratic
    hessian: Symmetric


def _expand(moments: jax.Array, p: Vector) -> _Expansion:
    sigma = once(covariance_at(moments, p))
    scale = 1 / symmetric.determinant(sigma)
    w = cast(Symmetric, tuple(scale * c for c in symmetric.adjugate(sigma)))
    w, slopes = once((w, covariance_gradient(moments, p)))
    gradient = cast(Vector, tuple(symmetric.trace_product(w, slope) for slope in slopes))
    products = [_product(w, slope) for slope in slopes]
    majorant, hessian = [], []
    for a, b in INDEX_PAIRS:
        column = moments[:, _QUADRATIC[a, b]]
        second = cast(Symmetric, tuple(column[i] for i in range(6)))
        curvature = (2.0 if a == b else 1.0) * symmetric.trace_product(w, second)
        coupling = sum(products[a][i][j] * products[b][j][i] for i in range(3) for j in range(3))
        majorant.append(curvature)
        hessian.append(curvature - coupling)
    return once(
        _Expansion(sigma, slopes, gradient, cast(Symmetric, tuple(majorant)), cast(Symmetric, tuple(hessian)))
    )


def _along(moments: jax.Array, slopes: tuple[Symmetric, ...], d: Vector) -> tuple[Symmetric, Symmetric]:
    """S1 and S2 of Sigma(p - l d) = Sigma(p) - l S1 + l^2 S2."""
    first, second = [], []
    for i in range(6):
        q = moments[i]
        first.append(d[0] * slopes[0][i] + d[1] * slopes[1][i] + d[2] * slopes[2][i])
        in_x = d[0] * q[4] + d[1] * q[5] + d[2] * q[6]
        second.append(d[0] * in_x + d[1] * (d[1] * q[7] + d[2] * q[8]) + d[2] * d[2] * q[9])
    return once((cast(Symmetric, tuple(first)), cast(Symmetric, tuple(second))))


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
        shape = x.shape
        moments, x = objective.moments.reshape(6, 10, -1), x.reshape(3, -1)
        low, high = box.bounds(x)

        def determinant(sigma: Symmetric) -> jax.Array:
            det = symmetric.determinant(sigma)
            return jnp.where(det > 0, det, jnp.inf)  # rounding, not a better point

        def step(carry: tuple[Vector, jax.Array], _: None) -> tuple[tuple[Vector, jax.Array], None]:
            p, best = carry
            here = _expand(moments, p)
            held = [
                ((p[i] <= low[i]) & (here.gradient[i] > 0)) | ((p[i] >= high[i]) & (here.gradient[i] < 0))
                for i in range(3)
            ]
            g = cast(Vector, tuple(jnp.where(held[i], 0, here.gradient[i]) for i in range(3)))
            trace = here.majorant[0] + here.majorant[3] + here.majorant[5]
            down = symmetric.solve(_hold(here.majorant, held, trace), g)
            newton = symmetric.solve(_hold(here.hessian, held, trace), g)
            down, newton = once((down, newton))

            # Newton's lengths, as far as the box allows, on the line along which Sigma is a quadratic
            slope = newton[0] * g[0] + newton[1] * g[1] + newton[2] * g[2]
            ahead = _room(p, newton, low, high)
            behind = _room(p, cast(Vector, tuple(-c for c in newton)), low, high)
            lengths = [jnp.clip(1 / (1 + slope / m), -behind, ahead) for m in (jnp.inf, 1.0, 2.0, 3.0)]
            lengths = once(lengths)
            first, second = _along(moments, here.slopes, newton)
            chosen_length = jnp.zeros_like(best)
            for length in lengths:
                on_line = zip(here.sigma, first, second, strict=True)
                sigma = tuple(s0 - length * (s1 - length * s2) for s0, s1, s2 in on_line)
                value = once(determinant(cast(Symmetric, sigma)))
                better = value < best  # false for NaN
                chosen_length = jnp.where(better, length, chosen_length)
                best = once(jnp.where(better, value, best))
            moved = (p[i] - chosen_length * newton[i] for i in range(3))
            chosen = once(cast(Vector, tuple(jnp.clip(c, low[i], high[i]) for i, c in enumerate(moved))))

            # the majorising step, cut short at the box and projected onto it
            for length in (once(_room(p, down, low, high)), jnp.ones_like(best)):
                moved = (p[i] - length * down[i] for i in range(3))
                trial = once(cast(Vector, tuple(jnp.clip(c, low[i], high[i]) for i, c in enumerate(moved))))
                value = once(determinant(covariance_at(moments, trial)))
                better = value < best
                picked = tuple(jnp.where(better, trial[i], chosen[i]) for i in range(3))
                chosen, best = once((cast(Vector, picked), jnp.where(better, value, best)))
            return (chosen, best), None

        start: Vector = (x[0], x[1], x[2])
        value = determinant(covariance_at(moments, start))
        (p, _), _ = jax.lax.scan(step, (start, value), length=self.steps)
        found = jnp.stack(p).reshape(shape)
        return found, objective.value(found)
