"""Densities of log amplitudes, and their integrals with the likelihood of a measured amplitude.

With u = log(a / size), the density of an amplitude a is proportional to
e^(B u) / (1 + e^(2 u))^((B + G) / 2). Its log has the slope B below the size and -G above.
The likelihood of a is Gaussian in log(a^2 + noise^2). For a far below the noise, the likelihood is constant,
and the integral of the density is interpolated between its two limits. Above, the trapezoidal rule computes
the integral with a few nodes.
"""

from math import gamma, log, pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import total as add
from reframe_jax.tuning import EVIDENCE as C

Array = jax.Array
_NODES = 4  # nodes of a likelihood; they integrate a Gaussian to within 3 %
_WIDTH = 3.5  # standard deviations of log a^2 on each side of the measured value
_FLAT = 0.05  # a^2 / noise^2 below which the likelihood counts as constant
_HELD_TOTAL = 5 * pi / 32  # integral of the density with slopes 1 and -7


class Nodes(NamedTuple):
    """Nodes of the likelihoods of amplitudes.

    Attributes:
        squares: (_NODES, 6, ...) a^2 of the nodes, ascending.
        weights: (_NODES, 6, ...) likelihood times the weight of the trapezoidal rule.
        below: (6, ...) likelihood of amplitudes below the first node.
        top: (6, ...) logarithm of a common factor of all weights.
    """

    squares: Array
    weights: Array
    below: Array
    top: Array

    def rows(self, rows: slice) -> "Nodes":
        """Select the nodes of some coordinates."""
        return Nodes(self.squares[:, rows], self.weights[:, rows], self.below[rows], self.top[rows])


def times_roots(nodes: Nodes) -> Nodes:
    """Multiply the weights and the likelihood below by the amplitudes, for :func:`held_likelihood`."""
    roots = jnp.sqrt(nodes.squares)
    return nodes._replace(weights=nodes.weights * roots, below=nodes.below * roots[0])


def held_likelihood(nodes: Nodes, sizes: Array) -> Array:
    """Compute the likelihood, divided by exp(top), of k held coordinates for a grid g of squared error sizes.

    The nodes are those of :func:`times_roots`. The sizes and the result have the shape (k, g, ...). The grid
    may have several axes.
    """
    squares, weights, below, _ = _spread(nodes, sizes.ndim)
    # slopes 1 and -7: sqrt(a^2 / s) / (1 + a^2 / s)^4, one division a node
    power = jnp.square(jnp.square(sizes / (sizes + squares)))
    rest = below / jnp.sqrt(sizes + squares[0] / _HELD_TOTAL**2)
    return (add(weights * power, 0) / jnp.sqrt(sizes) + rest) / _HELD_TOTAL


def free_evidence(nodes: Nodes, sizes: Array, slope: Array) -> Array:
    """Compute the log evidence (k, g, ...) of k free coordinates, for squared sizes (k or 1, g, ...).

    The slope B (...) is that of the log density below the size.
    """
    squares, weights, below, top = _spread(nodes, sizes.ndim)
    over = squares / (sizes + squares)
    power = jnp.exp(slope / 2 * jnp.log(over)) * (1 - over) ** int(C.free_above // 2)
    if C.free_above % 2:
        power = power * jnp.sqrt(1 - over)
    first = jnp.exp(slope / 2 * jnp.log(squares[0] / (sizes + squares[0])))
    total = add(weights * power, 0) + below * first / slope
    norm = jnp.polyval(jnp.asarray(_TOTALS, jnp.float32), jnp.log(slope))
    return jnp.log(total + jnp.finfo(jnp.float32).tiny) - norm + top


def _spread(nodes: Nodes, axes: int) -> Nodes:
    """Insert axes of size 1 for the grid after the axis of the coordinates."""
    extra = tuple(range(1, 1 + axes - nodes.top.ndim))
    one = tuple(axis + 1 for axis in extra)
    return Nodes(
        jnp.expand_dims(nodes.squares, one),
        jnp.expand_dims(nodes.weights, one),
        jnp.expand_dims(nodes.below, extra),
        jnp.expand_dims(nodes.top, extra),
    )


def amplitude_nodes(measured: Array, noise: Array, variance: Array) -> Nodes:
    """Compute the nodes of the likelihoods of amplitudes, in single precision.

    The arguments (6, ...) are the measured mean square, m^2 or rad^2, its part that is noise, and the
    variance of its log.
    """
    measured, noise, variance = (x.astype(jnp.float32) for x in (measured, noise, variance))
    ratio, deviation = jnp.log(measured / noise), jnp.sqrt(variance)
    low, high = (jnp.maximum(ratio + k * _WIDTH * deviation, log(1 + _FLAT)) for k in (-1, 1))
    # log (a / noise)^2 of the first and of the last node: log(e^x - 1)
    low, high = (x + jnp.log(1 - jnp.exp(-x)) for x in (low, high))
    high = jnp.maximum(high, low + 1e-3)
    steps = jnp.asarray(np.linspace(0, 1, _NODES), ratio.dtype).reshape(_NODES, *[1] * ratio.ndim)
    square = jnp.exp(low + (high - low) * steps)  # (a / noise)^2
    penalty = jnp.square(jnp.minimum(ratio, 0)) / variance
    misfit = jnp.square(ratio - jnp.log(1 + square)) / variance
    ends = np.ones(_NODES)
    ends[[0, -1]] = 0.5
    width = (high - low) / (2 * (_NODES - 1))  # node distance in log a
    weights = jnp.exp(-0.5 * (misfit - penalty)) * width * jnp.asarray(ends, ratio.dtype).reshape(steps.shape)
    return Nodes(
        square * noise,
        weights,
        jnp.exp(-0.5 * (jnp.square(ratio) / variance - penalty)),
        -0.5 * penalty - 0.5 * jnp.log(variance),
    )


# polynomial in log B of the log integral of the density with slopes B and -G
_SLOPES, _G = np.exp(np.linspace(log(0.5), log(4), 60)), C.free_above
_LOGS = [log(0.5 * gamma(b / 2) * gamma(_G / 2) / gamma((b + _G) / 2)) for b in _SLOPES]
_TOTALS = np.polyfit(np.log(_SLOPES), _LOGS, 5)
