"""The evidence for an entry of the table: how probable the measured amplitudes of its coordinates are.

The amplitude a of a coordinate is its RMS over the recording, summed over all used scales. It is measured
with a sampling error and white noise. The log density of log a depends on whether the coordinate is held:

- *held*: slope 1 below and -7 above the size e of slow errors of the tracker, the robot or the contact,
  where e^2 = n_p e_t^2 + n_r e_r^2: a translation error e_t, and a rotation error e_r that reaches the
  coordinate through its lever;
- *free*: slope B below and -3 above the size m of the motion, one m for rotations and one for translations.

The four sizes are the same for all coordinates of a recording, and are integrated out on grids. Sizes of slow
errors are correlated: errors of rotation cause errors of position. The densities
are smooth functions of the logarithm, so the trapezoidal rule is accurate with coarse steps.

Three terms are added. The first is a likelihood of the variances of all six coordinates, all scales alike;
it counts few independent values, because the samples of a motion are correlated. Errors that repeat with the
motion, as of an arm with wrong link lengths, can agree exactly with more freedom. Therefore, in entries with
a pitch, or with more free axes than that with the most probable amplitudes, variances far below the slow
errors do not count. The second term costs one unit of log evidence per parameter, and divides the prior of a
constraint among its representations. The third is for screws: they gain where the translation follows the
rotation, and pay for the pitch.
"""

from math import log
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.small import largest, materialize, total
from reframe_jax.model.amplitudes import Amplitudes
from reframe_jax.model.densities import Nodes, amplitude_nodes, free_evidence, held_likelihood, times_roots
from reframe_jax.model.table import Table
from reframe_jax.tuning import EVIDENCE as C

Array = jax.Array

_EXACT = 1e-16  # m^2 or rad^2, mean square below which a coordinate is constant
# ---- grids of the logarithms of sizes
_ERRORS = 1.4 * np.arange(-2, 6)  # log of slow errors over their median
_TURNS = np.array([-4, -2.5, -1, -0.5, 0, 0.5, 1, 2.5])  # log of free rotations over their median
_SHIFTS = np.array([-6, -4.5, -3, -2, -1, 0, 1, 2, 3.5])  # log of free translations over their median


def _motions() -> np.ndarray:
    """Prior probability of the sizes of free rotations and translations, (turns, shifts)."""
    # the usual sizes and the unusual ones; a node has the weight of the interval around it
    prior = np.zeros((len(_TURNS), len(_SHIFTS)))
    for fraction, spread in ((1 - C.unusual, 1.0), (C.unusual, C.unusual_spread)):
        turns = np.exp(-0.5 * (_TURNS / (spread * C.motion_spread)) ** 2) * np.gradient(_TURNS)
        levers = np.exp(-0.5 * ((_SHIFTS - _TURNS[:, None]) / (spread * C.motion_spread)) ** 2)
        shifts = levers * np.gradient(_SHIFTS)
        prior += fraction * (turns / turns.sum())[:, None] * shifts / shifts.sum(axis=1, keepdims=True)
    return prior


def _slow_errors() -> np.ndarray:
    """Prior probability of the sizes of slow errors of positions and of rotations, (G, G)."""
    unit, ends = _ERRORS / C.error_spread, np.ones(len(_ERRORS))
    ends[[0, -1]] = 0.5  # trapezoidal rule
    square = np.square(unit[:, None]) + np.square(unit) - 2 * C.error_correlation * unit[:, None] * unit
    prior = np.exp(-0.5 * square / (1 - C.error_correlation**2)) * ends[:, None] * ends
    return prior / prior.sum()


_MOTIONS, _SLOW_ERRORS = _motions(), _slow_errors()


def log_evidence(amplitudes: Amplitudes, tilt: Array, entry: Table, noise: Array, varies: Array) -> Array:
    """Compute the log evidence (...) of the coordinates, with the sizes of errors and motions integrated out.

    The tilt (...), rad, is the angle between the axis in {b} and in {g}; 0 for entries without a common axis.
    The noise (2, ...), m and rad, is white noise, which raises the prior of slow errors. Where positions or
    rotations do not vary along all axes, ``varies`` (2, ...) bool, as those of a planar tracker, constant
    coordinates were not measured: they show no errors.
    """
    nodes = materialize(amplitude_nodes(amplitudes.square, amplitudes.noise, amplitudes.variance))
    exact = ~jnp.repeat(varies[::-1], 3, axis=0) & (amplitudes.square < _EXACT)
    errors = _errors(nodes, amplitudes.lever, tilt, entry.held & ~exact, noise)
    value = errors + _moves(nodes, amplitudes, entry.held)
    return value.astype(amplitudes.square.dtype)


def _grid(values: np.ndarray, axes: int) -> Array:
    return jnp.asarray(values, jnp.float32).reshape(-1, *[1] * axes)


def _errors(nodes: Nodes, lever: Array, tilt: Array, held: Array, noise: Array) -> Array:
    """Log evidence of the held coordinates: slow errors e_r of rotations and e_t of translations."""
    least = jnp.asarray([C.error_position, C.error_rotation], noise.dtype).reshape(2, *[1] * (noise.ndim - 1))
    middle = (least**2 + jnp.square(C.error_of_noise * noise)).astype(jnp.float32)
    steps = _grid(np.exp(2 * _ERRORS), held.ndim - 1)
    e_t, e_r = middle[0] * steps, middle[1] * steps  # squares, (G, ...)
    lever, nodes = materialize((lever.astype(jnp.float32)[:, None], times_roots(nodes)))
    turns = jnp.where(held[:3, None], held_likelihood(nodes.rows(slice(0, 3)), e_r * lever[:3]), 1)
    ratio = e_r / (e_r + jnp.square(tilt).astype(jnp.float32))
    turns = materialize(turns[0] * turns[1] * turns[2] * ratio**3 * jnp.sqrt(ratio))
    sizes = e_t[None, :, None] + (e_r * lever[3:])[:, None]
    shifts = jnp.where(held[3:, None, None], held_likelihood(nodes.rows(slice(3, 6)), sizes), 1)
    value = materialize(turns * shifts[0] * shifts[1] * shifts[2]).reshape(-1, *tilt.shape)
    # a matrix product is the fastest sum over many rows
    whole = jnp.tensordot(jnp.asarray(_SLOW_ERRORS.ravel(), jnp.float32), value, 1, precision="highest")
    return jnp.log(whole + jnp.finfo(jnp.float32).tiny) + total(jnp.where(held, nodes.top, 0), 0)


def _moves(nodes: Nodes, amplitudes: Amplitudes, held: Array) -> Array:
    """Log evidence of the free coordinates: sizes m_r of rotations and m_t of translations."""
    lanes, sums = held.ndim - 1, []
    for first, grid, middle in ((0, _TURNS, C.turn), (3, _SHIFTS, C.turn * C.lever)):
        rows = slice(first, first + 3)
        squares = jnp.where(held[rows], -1, amplitudes.square[rows])
        independent = largest(jnp.where(squares == largest(squares), amplitudes.independent[rows], 0))
        slope = jnp.clip(jnp.sqrt(independent / 4), 0.5, 4).astype(jnp.float32)
        sizes = _grid(np.exp(2 * (grid + log(middle))), lanes)[None]
        free = jnp.where(held[rows, None], 0, free_evidence(nodes.rows(rows), sizes, slope))
        sums.append(materialize(total(free, 0)))
    tops = [largest(s) for s in sums]
    a, b = (jnp.exp(s - top) for s, top in zip(sums, tops, strict=True))
    shared = jnp.tensordot(jnp.asarray(_MOTIONS, jnp.float32), b, 1)
    return jnp.log(total(a * shared, 0) + jnp.finfo(jnp.float32).tiny) + tops[0] + tops[1]


class Evaluated(NamedTuple):
    """Values of entries that their comparison needs."""

    evidence: Array  # (...) result of :func:`log_evidence`
    consistency: Array  # (...) mean log |det| of the derivative of the coordinates with respect to the pose
    screw: Array  # (3, ...) result of :func:`screw_squares`
    independent: Array  # (6, ...) as in :class:`Amplitudes`
    log_variance: Array  # (6, ...)


def compare(entries: Evaluated, pitch: Array, table: Table, standard: np.ndarray) -> Array:
    """Compute the log probability (E, ...) of entries, but for a sum. Arrays end with entries and problems.

    The pitch is (E, ...), m/rad. The held coordinates of ``standard`` (E,) entries may show how large slow
    errors are.
    """
    evidence = entries.evidence
    first = jnp.arange(len(evidence)).reshape(-1, *[1] * (evidence.ndim - 1))
    best = first == jnp.argmax(jnp.where(standard.reshape(first.shape), evidence, -jnp.inf), axis=0)
    # the fewest values of a free coordinate of the best entry
    independent = jnp.min(jnp.where(~table.held & best, entries.independent, jnp.inf), axis=(0, 1))
    worth = jnp.minimum(jnp.where(jnp.isfinite(independent), independent, 1.0), C.worth)
    size = total(_raised(entries.log_variance, table, best), 0)
    value = evidence - worth * (0.5 * size - entries.consistency)
    value = value - jnp.log(table.variants) - table.parameters
    value = value + jnp.where(table.pitch, _screw(entries, pitch, worth), 0)
    value = jnp.where(evidence > -jnp.inf, value, -jnp.inf)
    # entries without held coordinates describe the same motion in the coordinates of different types: all of
    # them get a power mean of their probabilities, less the cost of such a motion
    nothing = ~jnp.any(table.held, axis=0) & jnp.isfinite(value)
    powers = jnp.where(nothing, C.nothing_power * value, -jnp.inf)
    mean = (jax.nn.logsumexp(powers, axis=0) - log(len(LinearType))) / C.nothing_power
    return jnp.where(nothing, mean - C.nothing_held, value)


def _raised(log_variance: Array, table: Table, best: Array) -> Array:
    """Log variances (6, E, ...), raised by a part of the slow errors in entries with a pitch or more freedom.

    The held coordinates of the entry ``best`` (E, ...) bool show how large the slow errors are.
    """
    shown = jnp.where(table.held & best, log_variance, jnp.inf).reshape(2, -1, *best.shape[1:])
    least = jnp.repeat(jnp.min(shown, axis=1), 3, axis=0)  # of rotations, of translations
    added = jnp.where(jnp.isfinite(least), jnp.exp(least) * C.repeatable_part**2, 0)
    number = total(table.held.astype(log_variance.dtype), 0)
    freer = table.pitch | (number < jnp.max(jnp.where(best, number, 0), axis=0))
    raised = jnp.log(jnp.exp(log_variance) + jnp.where(freer, added[:, None], 0))
    return jnp.minimum(raised, log_variance + 2 * log(C.repeatable_gain))


def screw_squares(amplitudes: Amplitudes) -> Array:
    """Mean squares (3, ...) of the rotation about the axis, the translation along it, and slow errors."""
    # slow errors, which the other held coordinates show, may be proportional to the rotation
    one, other, turn, *across, row = amplitudes.square
    tilts = (one + other) * jnp.maximum(*amplitudes.lever[3:5])
    errors = jnp.maximum(row, 0.5 * jnp.maximum(across[0] + across[1], tilts))
    return jnp.stack([turn, row, errors]).astype(jnp.float32)


def _screw(entries: Evaluated, pitch: Array, worth: Array) -> Array:
    """Log evidence (E, ...) of a screw: agreement of translation and rotation, less the cost of a pitch."""
    turn, row, errors = entries.screw
    travel = jnp.square(pitch).astype(jnp.float32) * turn
    values = jnp.maximum(jnp.minimum(entries.independent[2], C.screw_worth) - 1 - worth, 0)
    gain = values * 0.5 * jnp.log((errors + travel) / errors)
    return gain + jnp.minimum(0, 0.5 * jnp.log(row / (travel + 1e-24))) - C.pitch_cost
