"""Local steps for the position of a frame that do not stall in narrow valleys.

With the rotation eliminated, f(p) = 6 log J(p) near an optimum of a window with little noise is the
logarithm of a small number: a narrow, curved, concave-sided funnel, in which Newton's method on f
diverges and gradient descent crawls. For the geometric mean f is log det Sigma(p); for every power mean
of exponent up to 2 it is a concave function of Sigma. Each step here evaluates a few candidates and
keeps the best, so f never rises but for rounding:

- *majorize-minimize*: f is concave in Sigma, so its tangent tr(W(p0) Sigma(p)) bounds it from above,
  W = df/dSigma being the inverse of Sigma for the geometric mean; the bound is quadratic and its
  minimum one 3x3 solve. Best far from the optimum and where all three axes are constrained.
- *Newton on exp(f/m)*, m = 1, 2, 3, and on f: where m axes are constrained, det behaves as the m-th
  power of a quadratic, and the step for that m is exact. For other means m = 6, J itself, joins them.
  All share one direction, d = H^-1 g of f, and differ in length only: 1 / (1 + g.d / m). In a funnel
  g.d < 0 and the sign turns, which is why no damping is needed.

Coordinates on a face of the box whose gradient points outwards are held there, and the step is taken
in the others.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import lax, nn

from reframe_jax.geometry import symmetric
from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric, Vector
from reframe_jax.objectives.moments import (
    Coefficients,
    covariance_at,
    covariance_gradient,
    covariance_hessian,
    covariance_on_line,
)
from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.solvers.box import Box

__all__ = ["ValleySteps", "descend", "slope", "slope_and_curvature"]

_RIDGE = 1e-10  # of the Hessians, relative to the trace: keeps a free direction solvable


class _Expansion(NamedTuple):
    """Derivatives of f at a point.

    With W = df/dSigma and Sigma_a, Sigma_ab the derivatives of Sigma, g_a = tr(W Sigma_a) and
    A_ab = tr(W Sigma_ab); the Hessian is A and the curvature of f as a function of Sigma.
    """

    sigma: Symmetric
    slopes: tuple[Symmetric, ...]  # Sigma_a
    gradient: Vector
    majorant: Symmetric  # A, the curvature of the majorizing quadratic
    hessian: Symmetric


def _expand(moments: Coefficients, p: Vector, exponent: float) -> _Expansion:
    sigma, slopes = covariance_at(moments, p), covariance_gradient(moments, p)
    seconds = covariance_hessian(moments)
    if exponent == 0:
        gradient, majorant, curvature = _derivatives_of_det(sigma, slopes, seconds)
    else:
        gradient, majorant, curvature = _derivatives_of_mean(sigma, slopes, seconds, exponent)
    hessian = cast(Symmetric, tuple(m + c for m, c in zip(majorant, curvature, strict=True)))
    return _Expansion(sigma, slopes, *((gradient, majorant, hessian)))


def slope(objective: MomentsObjective, x: jax.Array) -> jax.Array:
    """Gradient of log J, (3, ...), with respect to the origins x, (3, ...)."""
    if objective.exponent != 0:
        return slope_and_curvature(objective, x)[0]
    p = x[0], x[1], x[2]
    weights = _Elimination.of(covariance_at(objective.moments, p))
    slopes = covariance_gradient(objective.moments, p)
    return jnp.stack([(lambda m: weights.trace(weights.turn(m)))(item) for item in slopes]) / 6


def slope_and_curvature(objective: MomentsObjective, x: jax.Array) -> tuple[jax.Array, Symmetric]:
    """Gradient, (3, ...), and Hessian of log J with respect to the origins x, (3, ...), in closed form."""
    here = _expand(objective.moments, (x[0], x[1], x[2]), objective.exponent)
    return jnp.stack(here.gradient) / 6, cast(Symmetric, tuple(h / 6 for h in here.hessian))


class _Elimination(NamedTuple):
    """Sigma = L D L^T, with which traces tr(Sigma^-1 M) are taken.

    Sigma^-1 itself, where one axis moves freely and another hardly at all, has lost the digits that they hang
    on.
    """

    inverse: Vector  # 1/D
    below: Vector  # the entries 10, 20 and 21 of L^-1

    @classmethod
    def of(cls, sigma: Symmetric) -> "_Elimination":
        xx, xy, xz, yy, yz, zz = sigma
        x = 1 / xx
        lyx, lzx = xy * x, xz * x
        dy = yy - xy * lyx
        coupling = yz - xy * lzx
        y = 1 / dy
        lzy = coupling * y
        z = 1 / (zz - xz * lzx - coupling * lzy)
        return cls((x, y, z), (-lyx, lyx * lzy - lzx, -lzy))

    def turn(self, m: Symmetric) -> Symmetric:
        """L^-1 M L^-T."""
        g10, g20, g21 = self.below
        xx, xy, xz, yy, yz, zz = m
        bx, by = xy + g10 * xx, yy + g10 * xy
        cx, cy, cz = xz + g21 * xy + g20 * xx, yz + g21 * yy + g20 * xy, zz + g21 * yz + g20 * xz
        return xx, bx, cx, by + g10 * bx, cy + g10 * cx, cz + g21 * cy + g20 * cx

    def trace(self, turned: Symmetric) -> jax.Array:
        """tr(Sigma^-1 M), of a matrix that was turned."""
        x, y, z = self.inverse
        return x * turned[0] + y * turned[3] + z * turned[5]


def _derivatives_of_det(
    sigma: Symmetric, slopes: tuple[Symmetric, ...], seconds: tuple[Symmetric, ...]
) -> tuple[Vector, Symmetric, Symmetric]:
    """For f = log det Sigma, W = Sigma^-1: the curvature of f is -tr(W Sigma_a W Sigma_b)."""
    weights = _Elimination.of(sigma)
    x, y, z = weights.inverse
    turned = [(weights.turn)(item) for item in slopes]
    scale = (x * x, x * y, x * z, y * y, y * z, z * z)

    def product(a: Symmetric, b: Symmetric) -> jax.Array:
        return symmetric.trace_product(
            cast(Symmetric, tuple(f * m for f, m in zip(scale, a, strict=True))), b
        )

    gradient = tuple(weights.trace(m) for m in turned)
    majorant = tuple([(lambda m: weights.trace(weights.turn(m)))(item) for item in seconds])
    curvature = tuple(-product(turned[a], turned[b]) for a, b in INDEX_PAIRS)
    return cast(Vector, gradient), cast(Symmetric, majorant), cast(Symmetric, curvature)


def _derivatives_of_mean(
    sigma: Symmetric, slopes: tuple[Symmetric, ...], seconds: tuple[Symmetric, ...], exponent: float
) -> tuple[Vector, Symmetric, Symmetric]:
    """For f = 6 log J of any power mean, a function of the eigenvalues s_i of Sigma.

    With q_i the share of axis i in the sum of s_i^(exponent/2), f_i = df/ds_i = 3 q_i / s_i, and M_a the
    matrix Sigma_a along the eigenvectors, the curvature of f is

        sum_ij f_ij M_a,ii M_b,jj + 2 sum_(i<j) (f_i - f_j) / (s_i - s_j) M_a,ij M_b,ij.
    """
    values, axes = symmetric.eigh(sigma)
    s = jnp.maximum(jnp.stack(values), jnp.finfo(values[0].dtype).tiny)
    if exponent == -math.inf:
        # the smallest counts alone
        share, own = jnp.stack([jnp.ones_like(s[0]), jnp.zeros_like(s[0]), jnp.zeros_like(s[0])]), 0.0
    else:
        share, own = nn.softmax(exponent / 2 * jnp.log(s), axis=0), exponent / 2
    s, share, first = (s, share, 3 * share / s)
    turned = [dict(zip(INDEX_PAIRS, symmetric.along(slope, axes), strict=True)) for slope in slopes]

    def second(i: int, j: int) -> jax.Array:
        change = -own * share[j] if i != j else own * (1 - share[i]) - 1
        return first[i] * change / s[j]

    def divided(i: int, j: int) -> jax.Array:
        gap = s[j] - s[i]
        close = gap <= 1e-6 * s[j]
        limit = second(i, i) - second(i, j)  # as s_j and f_j go to s_i and f_i
        return jnp.where(close, limit, (first[j] - first[i]) / jnp.where(close, 1, gap))

    on_axes = {(i, j): second(i, j) for i in range(3) for j in range(3)}
    between = {(i, j): divided(i, j) for i, j in INDEX_PAIRS if i != j}

    def trace(m: Symmetric) -> jax.Array:
        one, two, three = (first[i] * symmetric.quadratic_form(axes[i], m, axes[i]) for i in range(3))
        return one + two + three

    def bend(a: int, b: int) -> jax.Array:
        total = jnp.zeros_like(s[0])
        for (i, j), f in on_axes.items():
            total = total + f * turned[a][i, i] * turned[b][j, j]
        for ij, f in between.items():
            total = total + 2 * f * turned[a][ij] * turned[b][ij]
        return total

    gradient = tuple(trace(m) for m in slopes)
    majorant = tuple(trace(m) for m in seconds)
    curvature = tuple(bend(a, b) for a, b in INDEX_PAIRS)
    return cast(Vector, gradient), cast(Symmetric, majorant), cast(Symmetric, curvature)


def _along(moments: Coefficients, slopes: tuple[Symmetric, ...], d: Vector) -> tuple[Symmetric, Symmetric]:
    """S1 and S2 of Sigma(p - l d) = Sigma(p) - l S1 + l^2 S2."""
    first = tuple(d[0] * in_x + d[1] * in_y + d[2] * in_z for in_x, in_y, in_z in zip(*slopes, strict=True))
    second = covariance_on_line(moments, d)
    return (cast(Symmetric, first)), second


def _hold(matrix: Symmetric, held: list[jax.Array], trace: jax.Array) -> Symmetric:
    """The matrix with the rows and columns of held coordinates made diagonal, and a small ridge."""
    entries = []
    for (a, b), entry in zip(INDEX_PAIRS, matrix, strict=True):
        if a == b:
            entries.append(jnp.where(held[a], trace, entry + _RIDGE * trace))
        else:
            entries.append(jnp.where(held[a] | held[b], 0, entry))
    return cast(Symmetric, tuple(entries))


def _room(p: Vector, direction: Vector, low: Vector, high: Vector) -> jax.Array:
    """Largest length up to 1 for which p - length * direction stays in the box."""
    length = jnp.ones_like(p[0])
    for i in range(3):
        room = jnp.where(direction[i] > 0, p[i] - low[i], p[i] - high[i])
        inside = jnp.where(direction[i] == 0, 1, room / jnp.where(direction[i] == 0, 1, direction[i]))
        length = jnp.minimum(length, inside)
    return length


def _level(sigma: Symmetric, exponent: float) -> jax.Array:
    """What the steps compare: det Sigma for the geometric mean, log J for others.

    Infinite where Sigma is not positive definite: rounding, not a better point.
    """
    if exponent == 0:
        det = symmetric.determinant(sigma)
        return jnp.where(det > 0, det, jnp.inf)
    variances = jnp.stack(symmetric.eigh(sigma)[0])
    log_rms = jnp.log(jnp.where(variances > 0, variances, 1)) / 2
    return jnp.where(variances[0] > 0, log_power_mean(log_rms, exponent), jnp.inf)


def descend(
    moments: Coefficients, low: Vector, high: Vector, p: Vector, steps: int, exponent: float = 0.0
) -> tuple[Vector, jax.Array]:
    """Improve origins by a number of steps; elementwise operations only, so that it runs in a kernel.

    Args:
        moments: coefficients of Sigma, by component and monomial.
        low: faces of the box.
        high: faces of the box.
        p: where to start.
        steps: number of steps.
        exponent: of the power mean over axes.

    Returns:
        The origins, and det Sigma there (for the geometric mean) or log J.
    """
    powers = (jnp.inf, 1.0, 2.0, 3.0) if exponent == 0 else (jnp.inf, 1.0, 2.0, 3.0, 6.0)

    def step(_: int, carry: tuple[Vector, jax.Array]) -> tuple[Vector, jax.Array]:
        p, best = carry
        here = _expand(moments, p, exponent)
        held = [
            ((p[i] <= low[i]) & (here.gradient[i] > 0)) | ((p[i] >= high[i]) & (here.gradient[i] < 0))
            for i in range(3)
        ]
        g = cast(Vector, tuple(jnp.where(held[i], 0, here.gradient[i]) for i in range(3)))
        trace = symmetric.trace(here.majorant)
        both = here.majorant, here.hessian
        down, newton = [(lambda m: symmetric.solve(_hold(m, held, trace), g))(item) for item in both]

        # Newton's lengths, as far as the box allows, on the line along which Sigma is a quadratic
        slope = newton[0] * g[0] + newton[1] * g[1] + newton[2] * g[2]
        ahead = _room(p, newton, low, high)
        behind = _room(p, cast(Vector, tuple(-c for c in newton)), low, high)
        lengths = [jnp.clip(1 / (1 + slope / m), -behind, ahead) for m in powers]
        lengths = lengths
        first, second = _along(moments, here.slopes, newton)

        def on_line(length: jax.Array) -> jax.Array:
            terms = zip(here.sigma, first, second, strict=True)
            sigma = tuple(s0 - length * (s1 - length * s2) for s0, s1, s2 in terms)
            return _level(cast(Symmetric, sigma), exponent)

        chosen_length = jnp.zeros_like(best)
        for length, value in zip(lengths, [(on_line)(item) for item in lengths], strict=True):
            better = value < best  # false for NaN
            chosen_length = jnp.where(better, length, chosen_length)
            best = jnp.where(better, value, best)
        # without any rotation all directions are free, and Newton's is not finite
        stays = chosen_length == 0
        moved = (jnp.where(stays, p[i], p[i] - chosen_length * newton[i]) for i in range(3))
        chosen = cast(Vector, tuple(jnp.clip(c, low[i], high[i]) for i, c in enumerate(moved)))

        # the majorizing step, cut short at the box and projected onto it
        def trial(length: jax.Array) -> tuple[Vector, jax.Array]:
            moved = (p[i] - length * down[i] for i in range(3))
            there = cast(Vector, tuple(jnp.clip(c, low[i], high[i]) for i, c in enumerate(moved)))
            return there, _level(covariance_at(moments, there), exponent)

        for there, value in [(trial)(item) for item in ((_room(p, down, low, high)), jnp.ones_like(best))]:
            better = value < best
            picked = tuple(jnp.where(better, there[i], chosen[i]) for i in range(3))
            chosen, best = (cast(Vector, picked), jnp.where(better, value, best))
        return chosen, best

    return lax.fori_loop(0, steps, step, (p, _level(covariance_at(moments, p), exponent)))


@dataclass(frozen=True)
class ValleySteps:
    """Local minimizer of a :class:`PositionObjective`.

    Attributes:
        steps: number of steps; fixed, so that no problem waits for another.
    """

    steps: int = 12

    def __call__(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Improve the origins x, (3, ...).

        Returns:
            The new origins and their values, (...).

        Raises:
            ValueError: for another objective.
        """
        known = self.check(objective)
        batch = x.shape[1:]
        moments, x = known.moments.reshape(6, 10, -1), x.reshape(3, -1)
        low, high = box.bounds(x)
        bounds = cast(Vector, tuple(low)), cast(Vector, tuple(high))
        improve = partial(descend, steps=self.steps, exponent=known.exponent)
        p, _ = improve(moments, *bounds, (x[0], x[1], x[2]))
        found = jnp.stack(p).reshape(3, *batch)
        return found, objective.value(found)

    @staticmethod
    def check(objective: Objective) -> MomentsObjective:
        """The objective, if these steps can minimize it.

        Raises:
            ValueError: unless it is a :class:`MomentsObjective` whose unknowns are the position.
        """
        if isinstance(objective, MomentsObjective) and objective.unknowns == "position":
            return objective
        raise ValueError(
            f"ValleySteps minimize norms given by moments over positions alone (a PositionObjective), not a "
            f"{type(objective).__name__}; use FrameSteps, NewtonSteps or OptaxSteps for others."
        )
