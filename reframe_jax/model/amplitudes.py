"""Amplitudes of the coordinates of entries of the table: their RMS over a recording, and its errors.

A coordinate is a weight vector times the features of an entry: the path of its origin, the position of the
body, and the rotation. Its weights are found from the moments over the recording, all scales together; its
variance at every scale follows from the moments of that scale. Arrays have components first, then scales,
and problems last.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.kernel import added_up
from reframe_jax.geometry.small import (
    axial,
    crosses,
    diagonalize,
    largest,
    materialize,
    sandwich,
    solve_symmetric,
    times,
    total,
    unit_matrix,
)
from reframe_jax.model.rows import Forms
from reframe_jax.model.steps import Unknowns, axis_row
from reframe_jax.model.table import Table
from reframe_jax.tuning import EVIDENCE as C

Array = jax.Array
TINY = 1e-18  # m^2 and rad^2, added to every variance
_ACROSS = np.abs(np.cross(np.eye(3)[:, None], np.eye(3)))  # 1 where three axes differ
_RIDGE = 1e-6  # fraction of the trace that regularizes the regression of translations on rotations


class Spectra(NamedTuple):
    """Statistics of the scales of a window."""

    details: Array  # (S, ...) number of independent details, also at unused scales
    scale_weight: Array  # (S, ...) weight of a scale in the variance of a coordinate; 0 at unused scales
    white: Array  # (S, ...) variance of a detail for white noise of variance 1
    noise: Array  # (2, ...) m and rad, standard deviation of the white noise of a pose


class Amplitudes(NamedTuple):
    """Amplitudes of the six coordinates of an entry."""

    square: Array  # (6, ...) mean square over the recording, m^2 or rad^2
    noise: Array  # (6, ...) part of ``square`` that is white noise
    variance: Array  # (6, ...) variance of the logarithm of ``square``
    independent: Array  # (6, ...) number of independent values
    lever: Array  # (6, ...) squared sensitivity to a rotation, m^2 or 1
    log_variance: Array  # (6, ...) float32, mean over the used scales of the log of the variance


def amplitudes_of(
    forms: Forms, crossed: Array, at: Unknowns, entry: Table, lever: Array, sine: Array, spectra: Spectra
) -> Amplitudes:
    """Compute the amplitudes of the coordinates of entries, from their moments about the origins.

    Moments of the rotation coordinates of a universal joint are ``crossed`` (3, 3, S, ...), and the squared
    sine of the angle between its axes is (...). The lever (3, 3, ...), m^2, is the squared sensitivity of the
    translations to a rotation, in the main body.
    """
    frame, third = at.frame, (np.arange(3) == 2).reshape(3, *[1] * entry.apart.ndim)
    row, unit = third & entry.apart, unit_matrix(frame.dtype, entry.apart.ndim)
    whole, of_crossed = _over_recording(forms, crossed, spectra.scale_weight)
    left = jnp.concatenate([whole.path, jnp.swapaxes(whole.mixed, 0, 1)])
    right = jnp.concatenate([whole.mixed, whole.rows])
    joined = materialize(jnp.concatenate([left, right], axis=1))  # (9, 9, ...)
    # ---- translations as weights of the path, the position and the rotation, (9, 3, ...)
    along = jnp.concatenate([jnp.zeros_like(frame[0]), axis_row(at)])
    weights = jnp.concatenate([frame, jnp.zeros_like(frame), jnp.zeros_like(frame)])
    weights = jnp.where(row, along[:, None], weights)
    lever, turns = jnp.moveaxis(sandwich(frame, jnp.stack([lever, joined[6:, 6:]], axis=2)), 2, 0)
    # ---- less what rotations explain
    mixed = times(jnp.swapaxes(frame, 0, 1), times(joined[6:], weights))
    turns, mixed, lever = materialize((jnp.where(entry.crossed, of_crossed, turns), mixed, lever))
    levers = jnp.where(row, at.pitch**2, total(lever * unit, 0))
    slope = times(frame, _explained_by_rotations(turns, mixed, levers, entry))
    weights = materialize(jnp.concatenate([weights[:6], weights[6:] - slope]))
    # ---- coordinates of each block that do not correlate
    shifts = times(jnp.swapaxes(weights, 0, 1), materialize(times(joined, weights)))
    together = jnp.stack([entry.together[:3, :3], entry.together[3:, 3:]], axis=2)
    both = materialize(jnp.stack([turns, shifts], axis=2))
    axes = materialize(diagonalize(both[:, :, None], together=together, sweeps=3))
    turned, moved = axes[:, :, 0], axes[:, :, 1]
    directions = materialize((times(jnp.where(entry.crossed, unit, frame), turned), times(weights, moved)))
    first = (np.arange(3) == 0).reshape(third.shape)
    levers = jnp.where(row, at.pitch**2, total(moved * times(lever, moved), 0))
    levers = jnp.concatenate([jnp.where(first & entry.crossed, sine, 1), levers])
    # ---- their variances at every scale
    scale_weight = spectra.scale_weight
    smooth = (np.arange(len(scale_weight)) == len(scale_weight) - 1).reshape(-1, *[1] * entry.apart.ndim)
    shown = jnp.where((spectra.details > 0) & ~smooth, 1 / spectra.white, jnp.inf)
    scales = scale_weight, spectra.details, shown
    square, spread, logs, least = _over_scales(forms, crossed, directions, entry.crossed, *scales)
    of_position = (np.arange(6) >= 3).reshape(6, *third.shape[1:])
    noise = jnp.where(of_position, spectra.noise[0] ** 2, 0) + levers * spectra.noise[1] ** 2
    # the white noise is at most the variance at any scale
    noise = jnp.minimum(noise, -least) * total(scale_weight * spectra.white, 0) + 0.1 * TINY
    variance = spread / square**2
    return Amplitudes(
        square=square,
        noise=noise,
        variance=jnp.minimum(variance, 1),
        independent=2 / jnp.maximum(variance, 0.01),
        lever=levers,
        log_variance=logs / total((scale_weight > 0).astype(logs.dtype), 0),
    )


_SCALES = Forms(2, 2, 2)  # type: ignore[arg-type]  # axes of the scales


@partial(added_up, axes=(_SCALES, 2, 0))
def _over_recording(forms: Forms, crossed: Array, scale_weight: Array) -> tuple[Forms, Array]:
    """Return moments without scales: those of the whole recording."""
    return Forms(*(total(form * scale_weight, 2) for form in forms)), total(crossed * scale_weight, 2)


@partial(added_up, axes=(_SCALES, 2, -1, -1, 0, 0, 0), joins=(jnp.add, jnp.add, jnp.add, jnp.maximum))
def _over_scales(
    forms: Forms,
    crossed: Array,
    weights: tuple[Array, Array],
    is_crossed: Array,
    scale_weight: Array,
    details: Array,
    shown: Array,
) -> tuple[Array, Array, Array, Array]:
    """Sums (6, ...) over scales: mean square, its sampling variance, log variance; minus the least noise."""
    turns, path, rest = weights[0], weights[1][:3], weights[1][3:]
    of_turns = jnp.where(is_crossed, crossed, forms.rows[3:, 3:])
    shifts = _products(forms.path, path, path) + 2 * _products(forms.mixed, path, rest)
    shifts = shifts + _products(forms.rows, rest, rest)
    each = jnp.concatenate([_products(of_turns, turns, turns), shifts])
    each = materialize(jnp.maximum(each, 0) + TINY)  # (6, S, ...)
    parts = each * scale_weight
    logs = jnp.where(scale_weight > 0, jnp.log(each.astype(jnp.float32)), 0)
    spread = 2 * jnp.square(parts) / jnp.maximum(details, 1)
    return total(parts, 1), total(spread, 1), total(logs, 1), largest(-each * shown, 1)


def _products(form: Array, left: Array, right: Array) -> Array:
    """Products l_k' C_s r_k, (3, S, ...), of forms (m, n, S, ...), columns (m, 3, ...) and (n, 3, ...)."""
    half = materialize(total(form[:, :, None] * right[None, :, :, None], 1))
    return total(half * left[:, :, None], 0)


def _explained_by_rotations(turns: Array, mixed: Array, levers: Array, entry: Table) -> Array:
    """Return how much of each held translation (second index) to subtract per rotation (first), (3, 3, ...).

    An error d of a held rotation displaces the origin of the body by d x c if it acts about a point at -c,
    such as the centre of the markers, or the camera for a camera on the body. A regression yields c, so that
    the evidence hardly depends on the choice of the body frame. If only one rotation is free, held
    translations may be proportional to it: a tracker has a scale error.
    """
    # where nothing is free, the regression would explain every motion by errors
    turned = entry.held[:3] & ~entry.crossed & ~jnp.all(entry.held, axis=0)
    fixed, turned = (which.astype(turns.dtype) for which in (entry.held[3:], turned))
    unit = unit_matrix(turns.dtype, entry.apart.ndim)
    mixed = mixed * fixed
    # d x c along the held translations: the matrix of its mean square in c, and its product with them
    errors = turns * turned[:, None] * turned
    ones = _ACROSS.reshape(*_ACROSS.shape, *[1] * entry.apart.ndim)
    across = total(jnp.asarray(ones, turns.dtype) * fixed, 2)  # (3, 3, ...), 1 where the third axis is held
    size = total(errors * unit, 1)
    matrix = (times(across, size) + _RIDGE * total(size, 0) + TINY)[:, None] * unit - across * errors
    centre = solve_symmetric(materialize(matrix), -axial(turned[:, None] * mixed))
    most = C.scale_error * jnp.sqrt(levers)
    scale = jnp.clip(mixed[2] / (turns[2, 2] + TINY), -most, most)
    # the third rotation is free if there is a scale error
    only = unit[:, 2:] * (turned[0] * ~entry.held[2])
    return (turned[:, None] * crosses(centre) + only * scale) * fixed
