"""The evidence for an entry of the table: is what it holds held, and what it frees free?

A coordinate is its amplitude a, the RMS over the recording of all scales that are used, known up to its
sampling error and its white noise. Two densities of log a are compared:

- *held*: slope 1 below and -6 above the size e of slow errors of the tracker, the robot or the contact,
  where e^2 = n_p e_t^2 + n_r e_r^2: a translation of e_t and a rotation of e_r that reaches the coordinate
  through its lever;
- *free*: slope B below and -3 above the size m of the motion, one m for rotations and one for translations.

The four sizes belong to the recording and are integrated out on grids. To this come how well the held
coordinates are held against those of other entries, as a likelihood tempered to the few independent values that
a motion has, and a unit of log evidence for every parameter.
"""

from math import log
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.model.axes import common_axes
from reframe_jax.model.constants import EVIDENCE as C
from reframe_jax.model.table import ROWS, Table  # noqa: F401

__all__ = ["Amplitudes", "Spectra", "entry_amplitudes", "log_evidence", "log_posterior"]

Array = jax.Array

# ---- grids of log amplitude and of the logarithms of sizes
_STEP = 0.35
_GRID = np.arange(log(1e-8), log(8.0), _STEP)
_ERRORS = _STEP * np.arange(-12, 14)  # about the middle of the prior of slow errors
_SLOPES = np.array([0.5, 0.75, 1, 1.5, 2, 3, 4.0])


def _kernel(below: float, above: float) -> np.ndarray:
    """Density of log a about every center of the grid, (centre, a)."""

    def shape(u: np.ndarray) -> np.ndarray:
        return np.exp(below * u - 0.5 * (below + above) * np.logaddexp(0, 2 * u))

    total = shape(np.arange(-40, 40, _STEP)).sum()
    return shape(_GRID[None] - _GRID[:, None]) / total


_HELD = _kernel(1.0, C.held_above)
_FREE = np.stack([_kernel(b, C.free_above) for b in _SLOPES])


def _normal(x: np.ndarray, middle: np.ndarray | float, spread: float, axis: int) -> np.ndarray:
    q = np.exp(-0.5 * ((x - middle) / spread) ** 2)
    return q / q.sum(axis=axis, keepdims=True)


_MOTIONS = (
    _normal(_GRID, log(C.turn), C.turn_spread, 0)[:, None]
    * _normal(_GRID[None], _GRID[:, None] + log(C.lever), C.lever_spread, 1)
)
"""Prior of the sizes of free rotations and translations."""


class Spectra(NamedTuple):
    """What a window gives to the evidence.

    Attributes:
        products: (S, 27, 27) moments.
        details: (S,) independent details, 0 at scales that are not used.
        all_details: (S,) the same with those scales.
        share: (S,) of a scale in the variance of the path; 0 where it is not used.
        white: (S,) variance at a scale of white noise of unit variance.
        to_position, to_rotation: (M, 27, 3) sensitivity of the features to a pose.
        noise: (2,) m and rad, white noise of a pose.
    """

    products: Array
    details: Array
    all_details: Array
    share: Array
    white: Array
    to_position: Array
    to_rotation: Array
    noise: Array


class Amplitudes(NamedTuple):
    """The six coordinates of an entry.

    Attributes:
        square: (6,) mean square over the recording, m^2 or rad^2.
        noise: (6,) what white noise has of it.
        variance: (6,) of the logarithm of ``square``.
        independent: (6,) number of independent values.
        linear: (6,) whether a coordinate is in m.
        lever: (6,) squared sensitivity to a rotation, m^2 or 1.
        size: () sum over coordinates and scales of n log variance, of all coordinates.
        consistency: () mean log |det| of the derivative of the coordinates with respect to the pose.
    """

    square: Array
    noise: Array
    variance: Array
    independent: Array
    linear: Array
    lever: Array
    size: Array
    consistency: Array


def entry_amplitudes(weights: Array, entry: Table, spectra: Spectra) -> Amplitudes:
    """Amplitudes of the coordinates (6, 27) of an entry."""
    total = jnp.einsum("s,sfg->fg", spectra.share, spectra.products)
    blocks = jnp.where(entry.together, weights @ total @ weights.T, 0)
    one = jnp.ones(1, weights.dtype)
    turned = [common_axes(blocks[None, i : i + 3, i : i + 3], one).T @ weights[i : i + 3] for i in (0, 3)]
    weights = jnp.concatenate(turned)
    to_position = jnp.einsum("if,mfc->mic", weights, spectra.to_position)
    to_rotation = jnp.einsum("if,mfc->mic", weights, spectra.to_rotation)
    position_gain = jnp.mean(jnp.sum(jnp.square(to_position), axis=-1), axis=0)
    lever = jnp.mean(jnp.sum(jnp.square(to_rotation), axis=-1), axis=0)
    linear = jnp.arange(6) >= 3
    # rotations do not depend on positions: the derivative is block triangular
    det = _determinant(to_rotation[:, :3]) * _determinant(to_position[:, 3:])
    consistency = jnp.mean(jnp.log(jnp.abs(det) + 1e-6))
    # a tracker's error of scale: held translations may move with the largest rotation
    squares = jnp.einsum("if,fg,ig->i", weights, total, weights)
    turns = jnp.where(linear | entry.held, -1.0, squares)
    main = weights[jnp.argmax(turns)]
    pull = weights @ total @ main / jnp.maximum(main @ total @ main, 1e-30)
    most = C.scale_error * jnp.sqrt(lever)
    pull = jnp.where(linear & entry.held & (jnp.max(turns) > 0), jnp.clip(pull, -most, most), 0)
    weights = weights - pull[:, None] * main[None]
    tiny = 1e-18
    each = jnp.maximum(jnp.einsum("if,sfg,ig->is", weights, spectra.products, weights), 0) + tiny
    parts = each * spectra.share
    square = jnp.sum(parts, axis=1)
    noise = position_gain * spectra.noise[0] ** 2 + lever * spectra.noise[1] ** 2
    # white noise cannot exceed what any scale shows
    shown = jnp.min(jnp.where(spectra.all_details[:-1] > 0, each[:, :-1] / spectra.white[:-1], jnp.inf), axis=1)
    noise = jnp.minimum(noise, shown) * jnp.sum(spectra.share * spectra.white) + 0.1 * tiny
    variance = jnp.sum(2 * jnp.square(parts) / jnp.maximum(spectra.all_details, 1), axis=1) / square**2
    return Amplitudes(
        square=square,
        noise=noise,
        variance=jnp.minimum(variance, 1) + C.amplitude_variance,
        independent=2 / jnp.maximum(variance, 0.01),
        linear=linear,
        lever=lever,
        size=jnp.sum(jnp.log(each) * spectra.details),
        consistency=consistency,
    )


def _determinant(m: Array) -> Array:
    return jnp.sum(m[..., 0, :] * jnp.cross(m[..., 1, :], m[..., 2, :]), axis=-1)


def log_evidence(of: Amplitudes, tilt: Array, entry: Table, noise: Array) -> Array:
    """Log evidence of what is held and free, with the sizes of errors and motions integrated out.

    Args:
        of: the coordinates.
        tilt: () rad, of the axis between the bodies; 0 for entries without one.
        entry: row of the table.
        noise: (2,) m and rad, white noise, with which errors grow.
    """
    log_square, log_noise = jnp.log(of.square)[:, None], jnp.log(of.noise)[:, None]
    grid = jnp.asarray(_GRID, of.square.dtype)
    likelihood = -0.5 * jnp.square(log_square - jnp.logaddexp(log_noise, 2 * grid)) / of.variance[:, None]
    likelihood = likelihood - 0.5 * jnp.log(of.variance)[:, None]
    top = jnp.max(likelihood, axis=1, keepdims=True)
    weight = jnp.exp(likelihood - top)
    small = jnp.finfo(of.square.dtype).tiny
    held = jnp.log(weight @ jnp.asarray(_HELD.T, grid.dtype) + small) + top
    # ---- slow errors: rotations e_r, translations e_t
    least = jnp.asarray([C.error_position, C.error_rotation], grid.dtype)
    middle = 0.5 * jnp.log(least**2 + jnp.square(C.error_of_noise * noise))
    offsets = jnp.asarray(_ERRORS, grid.dtype)
    prior = -0.5 * jnp.square(offsets / C.error_spread)
    prior = prior - jax.nn.logsumexp(prior)
    e_t, e_r = middle[0] + offsets, middle[1] + offsets
    share = jnp.where(of.linear, 1.0, 0.0)[:, None, None]
    centre = share * jnp.exp(2 * e_t)[None, None, :] + of.lever[:, None, None] * jnp.exp(2 * e_r)[None, :, None]
    place = jnp.clip((0.5 * jnp.log(centre + 1e-18) - grid[0]) / _STEP, 0, len(_GRID) - 1.001)
    index = place.astype(jnp.int32)
    rest = place - index
    flat = held + jnp.zeros_like(grid)
    row = jnp.arange(6)[:, None, None]
    at_centre = flat[row, index] * (1 - rest) + flat[row, index + 1] * rest
    errors = jnp.sum(jnp.where(entry.held[:, None, None], at_centre, 0), axis=0)
    errors = errors + prior[:, None] + prior[None, :]
    errors = errors - 0.5 * C.held_above * jnp.log1p(jnp.square(tilt / jnp.exp(e_r)))[:, None]
    # ---- motions
    largest = [jnp.argmax(jnp.where(~entry.held & (of.linear == g), of.square, -1)) for g in (False, True)]
    slope = jnp.stack([jnp.sqrt(of.independent[i] / 4) for i in largest])
    which = jnp.argmin(jnp.abs(jnp.log(jnp.clip(slope, 0.5, 4))[:, None] - np.log(_SLOPES)), axis=1)
    kernels = jnp.asarray(_FREE, grid.dtype)[which]
    moves = []
    for g, kernel in enumerate(kernels):
        free = jnp.log(weight[3 * g : 3 * g + 3] @ kernel.T + small) + top[3 * g : 3 * g + 3]
        moves.append(jnp.sum(jnp.where(~entry.held[3 * g : 3 * g + 3, None], free, 0), axis=0))
    peaks = [jnp.max(m) for m in moves]
    a, b = (jnp.exp(m - peak) for m, peak in zip(moves, peaks, strict=True))
    motions = jnp.log(a @ jnp.asarray(_MOTIONS, grid.dtype) @ b + small) + peaks[0] + peaks[1]
    return jax.nn.logsumexp(errors) + motions


def log_posterior(
    evidence: Array, of: Amplitudes, pitch: Array, table: Table, details: Array
) -> Array:
    """Log probability of every entry, (E,).

    Args:
        evidence: (E,) of :func:`log_evidence`.
        of: amplitudes of all entries, with an axis (E,) in front.
        pitch: (E,) m/rad.
        table: the entries.
        details: (S,) independent details.
    """
    best = jnp.argmax(evidence)
    count = jnp.sum(details)
    free = ~table.held
    independent = jnp.min(jnp.where(free, of.independent, jnp.inf), axis=1)[best]
    independent = jnp.where(jnp.isfinite(independent), independent, 1.0)
    worth = jnp.minimum(independent, C.worth)
    tempered = worth / count
    value = evidence - 0.5 * tempered * (of.size - jnp.min(of.size)) + worth * of.consistency
    value = value - jnp.log(table.variants) - C.per_parameter * table.parameters
    value = value + jnp.where(table.pitch, _screw(of, pitch, worth), 0)
    return value - jax.nn.logsumexp(value)


def _screw(of: Amplitudes, pitch: Array, worth: Array) -> Array:
    """What a screw gains because two motions agree, and what the range of pitches costs, (E,)."""
    turn, row = of.square[:, 2], of.square[:, 5]
    travel = jnp.square(pitch) * turn
    values = jnp.maximum(jnp.minimum(of.independent[:, 2], C.screw_worth) - 1 - worth, 0)
    gain = values * jnp.maximum(0, 0.5 * jnp.log((row + travel) / row))
    return gain + jnp.minimum(0, 0.5 * jnp.log(row / (travel + 1e-24))) - C.pitch_range
