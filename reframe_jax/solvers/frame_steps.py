"""Local steps for the orientation and the origin of a frame together.

The general route: nothing is eliminated. A step turns the frame about its own axes by d and shifts its
origin, so no chart of the rotations is ever singular, and log J has closed derivatives in the step. With
S = E^T Sigma E the covariance along the axes and v_n = S_nn the variances,

    dv_x = 2 (S_xy d_z - S_xz d_y), and so on in cyclic order,

and the second derivatives are as simple. Let q_n be the share of axis n in the power mean of exponent r
(1/3 each in the geometric mean), l_n = log v_n, and a the mean of grad l_n with weights q_n. Then

    grad log J = a / 2,
    Hess log J = sum_n q_n (Hess v_n / v_n - (1 - r/2) grad l_n grad l_n^T) / 2 - (r/4) a a^T.

Each step evaluates a few candidates and keeps the best:

- *Newton on J^s*, d / (1 + s g.d) with d = H^-1 g: s = 6, 3 and 2 are exact where one, two or three axes
  of the geometric mean are constrained, s = 1 where a single axis dominates; s = 0 is Newton on log J;
- *descent*, where H is indefinite: with H = L D L^T, the step of L |D| L^T, and shares of it;
- *aligning and majorizing*, far from the optimum: turns by Jacobi's angles, which would each make an
  off-diagonal entry of S zero, and the least origin of sum_n q_n v_n(p) / v_n, which bounds log J from
  above because J is concave in the variances. Together, and one without the other.
"""

from dataclasses import dataclass
from math import inf
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from reframe_jax.geometry import rotations, symmetric
from reframe_jax.geometry.symmetric import INDEX_PAIRS, Symmetric, Vector
from reframe_jax.objectives.moments import (
    Coefficients,
    covariance_at,
    covariance_gradient,
    covariance_hessian,
)
from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.solvers.box import Box

__all__ = ["FrameSteps"]

_POWERS = (0.0, 1.0, 2.0, 3.0, 6.0)  # s of the Newton steps
_SHARES = (1.0, 0.25, 0.05)  # of the descent step
_RIDGE = 1e-11  # on the diagonal of H, of the sum of its row: keeps a free direction solvable

Axes = tuple[Vector, Vector, Vector]
Triangle = list[list[jax.Array]]
"""Rows of a symmetric matrix up to the diagonal."""


class _Frame(NamedTuple):
    axes: Axes  # columns of E
    position: Vector


class _Expansion(NamedTuple):
    """Derivatives of log J with respect to a step: d, then the shift unless there is no position."""

    gradient: list[jax.Array]
    hessian: Triangle
    covariance: Symmetric  # S
    majorant: Symmetric | None  # curvature of the majorizing quadratic in the shift


def _variances(moments: Coefficients, frame: _Frame) -> Vector:
    sigma = covariance_at(moments, frame.position)
    x, y, z = (symmetric.quadratic_form(e, sigma, e) for e in frame.axes)
    return x, y, z


def _level(moments: Coefficients, frame: _Frame, exponent: float) -> jax.Array:
    """Logarithm of J; infinite where there is none."""
    log_rms = jnp.log(jnp.stack(_variances(moments, frame))) / 2
    value = log_power_mean(log_rms, exponent)
    return jnp.where(jnp.isnan(value), jnp.inf, value)


def _turning(s: Symmetric) -> tuple[Vector, Vector, Vector]:
    """Derivatives of each diagonal entry of E^T Sigma E with respect to d, from its other entries."""
    xy, xz, yz, zero = s[1], s[2], s[4], jnp.zeros_like(s[1])
    return (zero, -2 * xz, 2 * xy), (2 * yz, zero, -2 * xy), (-2 * yz, 2 * xz, zero)


def _turning_twice(s: Symmetric) -> tuple[Symmetric, Symmetric, Symmetric]:
    """Second derivatives of each diagonal entry of E^T Sigma E with respect to d."""
    xx, xy, xz, yy, yz, zz = s
    zero = jnp.zeros_like(xx)
    return (
        (zero, xy, xz, 2 * (zz - xx), -2 * yz, 2 * (yy - xx)),
        (2 * (zz - yy), xy, -2 * xz, zero, yz, 2 * (xx - yy)),
        (2 * (yy - zz), -2 * xy, xz, 2 * (xx - zz), yz, zero),
    )


def _shares(variances: Vector, exponent: float) -> Vector:
    """Share of every axis in the power mean."""
    if exponent == 0:
        third = jnp.full_like(variances[0], 1 / 3)
        return third, third, third
    logs = jnp.log(jnp.stack(variances))
    if exponent == -inf:
        x, y, z = jax.nn.one_hot(jnp.argmin(logs, axis=0), 3, dtype=logs.dtype, axis=0)
    else:
        x, y, z = jax.nn.softmax(exponent / 2 * logs, axis=0)
    return x, y, z


def _expand(moments: Coefficients, frame: _Frame, exponent: float) -> _Expansion:
    axes, p = frame
    s = symmetric.along(covariance_at(moments, p), axes)
    v = s[0], s[3], s[5]
    q = _shares(v, exponent)
    weights = tuple(q[n] / (2 * v[n]) for n in range(3))

    def weighted(of_axes: tuple[jax.Array, ...]) -> jax.Array:
        return weights[0] * of_axes[0] + weights[1] * of_axes[1] + weights[2] * of_axes[2]

    slopes = [list(of_axis) for of_axis in _turning(s)]
    seconds = _turning_twice(s)
    entries = {(j, i): weighted(tuple(m[k] for m in seconds)) for k, (i, j) in enumerate(INDEX_PAIRS)}
    if len(moments[0]) > 1:
        for a, sigma_a in enumerate(covariance_gradient(moments, p)):
            s_a = symmetric.along(sigma_a, axes)
            for n, slope in enumerate((s_a[0], s_a[3], s_a[5])):
                slopes[n].append(slope)
            turning = _turning(s_a)
            entries |= {(3 + a, j): weighted(tuple(of_axis[j] for of_axis in turning)) for j in range(3)}
        for (a, b), sigma_ab in zip(INDEX_PAIRS, covariance_hessian(moments), strict=True):
            along = tuple(symmetric.quadratic_form(e, sigma_ab, e) for e in axes)
            entries[3 + b, 3 + a] = weighted(along)
    dim = len(slopes[0])
    logs = [[slope / v[n] for slope in slopes[n]] for n in range(3)]
    mean = [q[0] * logs[0][i] + q[1] * logs[1][i] + q[2] * logs[2][i] for i in range(dim)]
    own = 0.0 if exponent == -inf else exponent  # with all the share on one axis both its terms cancel
    hessian = []
    for i in range(dim):
        row = []
        for j in range(i + 1):
            outer = sum((q[n] * logs[n][i] * logs[n][j] for n in (1, 2)), q[0] * logs[0][i] * logs[0][j])
            row.append(entries[i, j] - (0.5 - own / 4) * outer - own / 4 * mean[i] * mean[j])
        hessian.append(row)
    majorant = tuple(entries[3 + b, 3 + a] for a, b in INDEX_PAIRS) if dim == 6 else None
    return _Expansion([m / 2 for m in mean], hessian, s, cast(Symmetric | None, majorant))


def _aligning(s: Symmetric) -> jax.Array:
    """Turns about the axes, (3, ...), each of which by itself makes an off-diagonal entry of S zero."""
    xx, xy, xz, yy, yz, zz = s

    def angle(first: jax.Array, second: jax.Array, off: jax.Array) -> jax.Array:
        half = (second - first) / 2
        tangent = off / (jnp.abs(half) + jnp.hypot(half, off))
        return jnp.arctan(jnp.where(off == 0, 0, jnp.where(half < 0, -tangent, tangent)))

    return jnp.stack([angle(yy, zz, yz), -angle(xx, zz, xz), angle(xx, yy, xy)])


def _majorising(here: _Expansion, majorant: Symmetric) -> jax.Array:
    """Shift to the minimum of the majorizing quadratic, (3, ...), to be taken away from the origin."""
    ridge = _RIDGE * symmetric.trace(majorant)
    entries = (m + ridge if a == b else m for m, (a, b) in zip(majorant, INDEX_PAIRS, strict=True))
    return jnp.stack(symmetric.solve(cast(Symmetric, tuple(entries)), cast(Vector, tuple(here.gradient[3:]))))


def _directions(gradient: list[jax.Array], hessian: Triangle) -> jax.Array:
    """H^-1 g and (L |D| L^T)^-1 g for H = L D L^T, (2, dim, ...)."""
    dim = len(gradient)
    lower: Triangle = [[] for _ in range(dim)]
    inverse: list[jax.Array] = []
    pivots: list[jax.Array] = []
    for j in range(dim):
        size = sum((jnp.abs(hessian[max(i, j)][min(i, j)]) for i in range(dim)), jnp.zeros_like(gradient[j]))
        column = [hessian[i][j] - _dot(lower[i], lower[j], pivots) for i in range(j, dim)]
        pivot = column[0] + _RIDGE * size
        pivots.append(jnp.where(pivot == 0, 1, pivot))
        inverse.append(1 / pivots[j])
        for i in range(j + 1, dim):
            lower[i].append(column[i - j] * inverse[j])
    forward: list[jax.Array] = []
    for i in range(dim):
        forward.append(gradient[i] - _dot(lower[i], forward))
    found = []
    for scale in (inverse, [jnp.abs(c) for c in inverse]):
        x: list[jax.Array] = []  # from the last to the first
        for i in reversed(range(dim)):
            below = [lower[k][i] for k in reversed(range(i + 1, dim))]
            x.append(forward[i] * scale[i] - _dot(below, x))
        found.append(jnp.stack(x[::-1]))
    return jnp.stack(found)


def _dot(a: list[jax.Array], b: list[jax.Array], weights: list[jax.Array] | None = None) -> jax.Array | float:
    terms = [x * y for x, y in zip(a, b, strict=False)]
    terms = terms if weights is None else [t * w for t, w in zip(terms, weights, strict=False)]
    return sum(terms[1:], terms[0]) if terms else 0.0


def _turned(axes: Axes, d: Vector) -> Axes:
    """E times the rotation of the unit quaternion along (1, d / 2), which is exp(d) to second order."""
    scale = jax.lax.rsqrt(1 + (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / 4)
    w, (x, y, z) = scale, (scale / 2 * c for c in d)
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )

    def times(column: Vector) -> Vector:
        i, j, k = (axes[0][c] * column[0] + axes[1][c] * column[1] + axes[2][c] * column[2] for c in range(3))
        return i, j, k

    return times(columns[0]), times(columns[1]), times(columns[2])


def _descend(
    moments: Coefficients, low: Vector, high: Vector, frame: _Frame, steps: int, exponent: float
) -> tuple[_Frame, jax.Array]:
    """Improve frames by a number of steps; elementwise over the problems."""
    placed = len(moments[0]) > 1

    def moved(frame: _Frame, step: jax.Array) -> _Frame:
        axes = _turned(frame.axes, (-step[0], -step[1], -step[2]))
        if not placed:
            return _Frame(axes, frame.position)
        x, y, z = (jnp.clip(frame.position[a] - step[3 + a], low[a], high[a]) for a in range(3))
        return _Frame(axes, (x, y, z))

    def held(frame: _Frame, here: _Expansion) -> tuple[list[jax.Array], Triangle]:
        """Gradient and Hessian with the coordinates held whose gradient points out of the box."""
        p, gradient = frame.position, here.gradient
        stays = [jnp.zeros_like(p[0], dtype=bool)] * 3
        stays += [
            ((p[a] <= low[a]) & (gradient[3 + a] > 0)) | ((p[a] >= high[a]) & (gradient[3 + a] < 0))
            for a in range(3)
        ]
        gradient = [jnp.where(still, 0, g) for still, g in zip(stays, gradient, strict=True)]
        hessian = [
            [jnp.where(stays[i] | stays[j], float(i == j), entry) for j, entry in enumerate(row)]
            for i, row in enumerate(here.hessian)
        ]
        return (gradient, hessian)

    def step(_: int, carry: tuple[_Frame, jax.Array]) -> tuple[_Frame, jax.Array]:
        frame, best = carry
        here = _expand(moments, frame, exponent)
        gradient, hessian = (here.gradient, here.hessian) if here.majorant is None else held(frame, here)
        newton, descent = tuple(_directions(gradient, hessian))
        slope = jnp.sum(newton * jnp.stack(gradient), axis=0)
        steps = [newton / (1 + power * slope)[None] for power in _POWERS]
        steps += [share * descent for share in _SHARES]
        turn = _aligning(here.covariance)
        if here.majorant is None:
            steps.append(turn)
        else:
            shift, still = (_majorising(here, here.majorant)), jnp.zeros_like(turn)
            steps += [jnp.concatenate(pair) for pair in ((turn, shift), (turn, still), (still, shift))]
        trials = jnp.stack(steps)

        def attempt(i: jax.Array, carry: tuple[_Frame, jax.Array]) -> tuple[_Frame, jax.Array]:
            """A loop, so that it is compiled once."""
            chosen, best = carry
            trial = moved(frame, jax.lax.dynamic_index_in_dim(trials, i, keepdims=False))
            value = _level(moments, trial, exponent)
            better = value < best
            chosen = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, chosen)
            return (chosen, jnp.where(better, value, best))

        return jax.lax.fori_loop(0, len(trials), attempt, (frame, best))

    return jax.lax.fori_loop(0, steps, step, (frame, _level(moments, frame, exponent)))


@dataclass(frozen=True)
class FrameSteps:
    """Local minimizer of a :class:`FrameObjective`: orientation and origin together, any power mean.

    The origin stays in the box. Orientations are unbounded: the box bounds only their starts.

    Attributes:
        steps: number of steps; fixed, so that no problem waits for another.
    """

    steps: int = 10

    def __call__(self, objective: Objective, box: Box, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Improve the unknowns x, (dim, ...): rotation vectors, and origins unless there are none.

        Returns:
            The new unknowns and their values, (...).

        Raises:
            ValueError: for another objective.
        """
        known = self.check(objective)
        batch = x.shape[1:]
        moments, x = known.moments.reshape(6, -1, *x[0].reshape(-1).shape), x.reshape(len(x), -1)
        low, high = box.bounds(x)
        axes = rotations.rotation_exp(x[:3].T)
        columns = tuple(tuple(axes[:, i, n] for i in range(3)) for n in range(3))
        position = tuple(x[3:]) if len(x) == 6 else tuple(jnp.zeros_like(x))
        start = _Frame(cast(Axes, columns), cast(Vector, position))
        faces = cast(Vector, tuple(low[3:])), cast(Vector, tuple(high[3:]))
        found, _ = _descend(moments, *faces, start, self.steps, known.exponent)
        turned = rotations.rotation_log(jnp.stack([jnp.stack(e, axis=-1) for e in found.axes], axis=-1)).T
        moved = jnp.concatenate([turned, jnp.stack(found.position)[: len(x) - 3]])
        return moved.reshape(-1, *batch), objective.value(moved.reshape(-1, *batch))

    @staticmethod
    def check(objective: Objective) -> MomentsObjective:
        """The objective, if these steps can minimize it.

        Raises:
            ValueError: unless it is a :class:`MomentsObjective` whose unknowns are the frame.
        """
        if isinstance(objective, MomentsObjective) and objective.unknowns == "frame":
            return objective
        raise ValueError(
            "FrameSteps minimize norms given by moments over orientation and origin (a FrameObjective), "
            f"not a {type(objective).__name__}; use ValleySteps, NewtonSteps or OptaxSteps for others."
        )
