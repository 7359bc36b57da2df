"""Fit the identified constraint again, to a recording and to parts of the recording.

A covariance has nine components: a rotation of the angular axes and of the linear axes, as rotation vectors
in the bodies of their types (rad), and a shift of the origin (m).
"""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import Program, inside_trace, narrow, pipeline, traced
from reframe_jax.constraints.types import ORIENTATION_BODIES, POSITION_BODIES, AngularType
from reframe_jax.geometry.rotations import rotation_exp, vee
from reframe_jax.identification.cautions import Caution
from reframe_jax.identification.frames import AngularFrame, LinearFrame
from reframe_jax.identification.inputs import in_chunks, run_in_pieces, run_in_trace, take_poses, take_steps
from reframe_jax.identification.options import Scales, take_scales
from reframe_jax.identification.pipeline import prepare
from reframe_jax.identification.preparation import Prepared
from reframe_jax.identification.results import Identification
from reframe_jax.model.fit import Data, Parameters, coordinates_along, fit_entry, ground_axes, move
from reframe_jax.model.moments import Moments, scale_moments
from reframe_jax.model.solve import choose_scales
from reframe_jax.model.table import PATHS, Table, entries_at

Array = jax.Array

SPANS = ((0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Parts of a window to fit: part i of n equal parts, as (i, n)."""
BLOCKS = 6
"""Number of blocks, of which each fit leaves out one."""
_CHUNK = {"cpu": 8, "gpu": 1024}  # windows per chunk, so that the moments of all parts fit into memory
_PRIOR_ANGLE, _PRIOR_PITCH = 1.0, 1.0  # rad and m/rad, prior standard deviations
_IN_GROUND = np.array([path in ("GG", "BG") for path in PATHS])  # origins of entries, by ``Table.path``


class Estimate(NamedTuple):
    """Identified frames, from which the fit starts: fields of the :class:`Identification` of N windows."""

    entry_code: Array
    angular: AngularFrame
    linear: LinearFrame
    pitch: Array
    universal_axes: Array


class Windows(NamedTuple):
    """Data for the fit of N windows."""

    box: Array  # (N,) m, half the width of the cube of origins
    moments: Moments  # of the used scales
    mean_matrix: Array  # (N, 3, 3) mean of all R
    mean_rotation: Array  # (N, 3, 3) the rotation nearest to it
    entry: Table  # (N,) rows of the table of constraints
    start: Parameters  # initial parameters
    found: Estimate  # the identified frames
    axes: Array  # (N, 2, 3, 3) their angular and linear axes


class Refit(NamedTuple):
    """Constraints fitted to parts of windows, with (N, M) in front; the first part is the whole window."""

    tilt: Array  # (2,) rad, between the axis in the body and in the ground
    products: Array  # (S, 27, 27) moments of the part
    details: Array  # (S,) independent details of the part
    numbers: Array  # (9,) components of each fit, relative to the fit of the whole window
    slopes: Array  # (9, 9) derivative of the components with respect to a step of the parameters
    weights: Array  # (6, 27) of the coordinates, as in the fit
    weight_slopes: Array  # (6, 27, 9) derivative of the weights with respect to a step of the parameters
    poses: Array  # () number of poses in the part
    entry: Table  # row of the table of constraints
    prior: Array  # (9,) prior standard deviations of the parameters

    def of_whole(self) -> "Refit":
        """Return the fit of one whole window, without the axis of parts."""
        whole: Refit = jax.tree.map(lambda leaf: leaf[0], self)
        return whole


def over_windows(
    function: Callable[..., Any],
    found: Identification,
    poses: "ArrayLike",
    times: "ArrayLike | None",
    dt: "ArrayLike | None",
    scales: Scales,
    **static: Any,
) -> Any:
    """Call a function of N windows for the windows of an identification, single, many or traced.

    The arguments of the function are prepared windows, their :class:`Windows`, the scales of
    :func:`.take_scales`, and the keywords ``static``; it must be defined at module level, so that it compiles
    only once. Poses, times, dt and scales are those of the user. The result is that of the function, with the
    leading axes of ``found`` in place of the axis of windows.

    Raises:
        ValueError: if the poses or times do not match ``found``.
    """
    array = take_poses(poses)
    expected = (*np.shape(found.counted), 4, 4)
    if array.shape != expected:
        raise ValueError(f"poses must be the identified poses, of shape {expected}, not {array.shape}.")
    codes = found.warning_codes
    if np.ndim(codes) == 0 and not traced(codes) and int(codes) & Caution.UNORDERED and scales == "auto":
        scales = "mean"  # as the identification was made
    wide = not isinstance(array, jax.Array) and array.dtype == np.float64
    with jax.enable_x64(True) if wide else contextlib.nullcontext():
        steps = take_steps(array, times, dt).astype(array.dtype)
        estimate = Estimate(*(getattr(found, name) for name in Estimate._fields))
        tracing = inside_trace((array, steps, estimate))
        # NumPy needs no program for every shape
        xp = jnp if tracing or isinstance(array, jax.Array) else np
        estimate = jax.tree.map(
            lambda x: xp.asarray(x, array.dtype if jnp.issubdtype(x.dtype, jnp.floating) else None), estimate
        )
        arrays = take_scales(scales, array.shape[-3]), np.asarray(np.nan, array.dtype)  # scales and bounds
        run = partial(_run_windows, *arrays, function=function, **static)
        if tracing:
            result = run_in_trace(run, array, steps, estimate, _CHUNK)
        else:
            result = run_in_pieces(run, array, steps, estimate, _CHUNK, True)
    return result if tracing else narrow(result)


def _refit(scales: Array, bounds: Array, windows: Any, number: Array | None, **static: Any) -> Any:
    """Prepare windows for the fit, and call the function; for the windows, see :func:`run_in_pieces`."""
    *poses, found = windows
    window = prepare(tuple(poses), number, bounds, scales, single_steps=False)
    return _call_program((window, found), number, scales, **static)


def _call_function(windows: tuple[Prepared, Estimate], scales: Array, *, function: Any, **static: Any) -> Any:
    """Call a function of N windows for prepared windows."""
    window, found = jax.lax.stop_gradient(windows[0]), windows[1]
    weights = choose_scales(window.moments, window.noise, scales)
    used = window.moments._replace(details=weights.search)
    mean = window.features.mean_rotation
    entry = jax.vmap(entries_at)(jnp.maximum(found.entry_code, 0))
    axes = rotation_exp(jnp.stack([found.angular.rotvec, found.linear.rotvec], axis=1))
    start = jax.vmap(_start)(found, axes, window.centre, mean, entry)
    fits = Windows(window.box, used, window.features.mean_matrix, mean, entry, start, found, axes)
    return function(window, fits, scales, **static)


_call_program = Program(in_chunks(_call_function, _CHUNK), ("function", "parts"))
_run_windows = pipeline(_refit)


def refit_windows(window: Prepared, windows: Windows, scales: Array, parts: str) -> Refit:
    """Fit the identified constraints to prepared windows and to parts of them, with the same time scales.

    The parts are "whole"; "spans", with halves and thirds; or "blocks", with six parts that each lack one of
    six blocks.
    """
    products, details = windows.moments.products[:, None], windows.moments.details[:, None]
    number = window.length[:, None]
    if parts != "whole":
        moments, of_parts = _moments_of_parts(window, parts, scales == 0)
        noise = jnp.repeat(window.noise, of_parts.shape[1], axis=0)
        used = moments._replace(details=choose_scales(moments, noise, scales).search)
        more = align_scales(used, details.shape[2])
        products, details = (
            jnp.concatenate([whole, part.reshape(len(whole), -1, *part.shape[1:])], axis=1)
            for whole, part in zip((products, details), more, strict=True)
        )
        number = jnp.concatenate([number, of_parts], axis=1)
    return jax.vmap(_fit_window)(windows, products, details, number)


def align_scales(moments: Moments, count: int) -> tuple[Array, Array]:
    """Products and details at the scales of a recording with ``count`` scales; the smooth part is the last.

    Scales that are longer than the motion have no independent values.
    """
    index, last = np.arange(count), moments.details.shape[1] - 1
    place = np.where(index == count - 1, last, np.minimum(index, last))
    present = (index < last) | (index == count - 1)
    return moments.products[:, place], jnp.where(present, moments.details[:, place], 0)


def _moments_of_parts(window: Prepared, parts: str, about_mean: Array) -> tuple[Moments, Array]:
    """Moments (N * M, ...) of the parts of windows, and the number of poses in each part, (N, M)."""
    values, count = window.features.values, window.length
    every = jnp.arange(values.shape[2], dtype=jnp.int32)
    if parts == "spans":
        part, number = np.array(SPANS, np.int32).T
        first, end = (count[:, None] * (part + i) // number for i in (0, 1))
        place = first[:, :, None] + every[: -(-values.shape[2] // 2)]
        own = place < end[:, :, None]
        place, length = jnp.minimum(place, values.shape[2] - 1), end - first
    else:
        block = every * BLOCKS // count[:, None]
        own = (block[:, None] != jnp.arange(BLOCKS)[:, None]) & (block < BLOCKS)[:, None]
        place = jnp.broadcast_to(every, own.shape)
        length = jnp.broadcast_to(count[:, None], own.shape[:2])

    def take(values: Array) -> Array:
        """Take the poses of the parts, (N * M, ..., P), from values (N, ..., P) of windows."""
        taken = jax.vmap(jax.vmap(lambda value, i: value[..., i], (None, 0)))(values, place)
        return taken.reshape(-1, *taken.shape[2:])

    own = own.reshape(-1, own.shape[2])
    moments = scale_moments(take(values), own, length.ravel(), take(window.section), about_mean)
    return moments, jnp.sum(own, axis=1).reshape(length.shape)


def _fit_window(window: Windows, products: Array, details: Array, poses: Array) -> Refit:
    """Fit the parts (M, ...) of one window."""
    box, _, matrix, mean, entry, start, found, axes = window
    free = jnp.stack([found.angular.free_rotation, found.linear.free_rotation])

    def fit(products: Array, details: Array) -> Parameters:
        return fit_entry(start, Data(products, details, mean, box), entry, matrix)

    parameters = jax.vmap(fit)(products, details)
    first = jax.tree.map(lambda leaf: leaf[0], parameters)
    whole = _frames(first, ground_axes(first, mean), mean, found, entry)
    one = jnp.ones((), products.dtype)
    prior = jnp.stack([_PRIOR_ANGLE * one] * 3 + [box] * 3 + [_PRIOR_ANGLE * one] * 2 + [_PRIOR_PITCH * one])

    def expand(parameters: Parameters, products: Array, details: Array, poses: Array) -> Refit:
        """Compute the components of a fit, the weights of its coordinates, and their derivatives."""

        def after(step: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
            moved = move(parameters, step, box)
            ground = ground_axes(moved, mean)
            frames, origin = _frames(moved, ground, mean, found, entry)
            turned, shift = frames @ jnp.swapaxes(whole[0], 1, 2), origin - whole[1]
            turns = jax.vmap(turn_of_frame)(axes, free, turned).ravel()
            numbers = jnp.concatenate([turns, shift - found.linear.free_position @ shift])
            values = numbers, coordinates_along(ground, moved, entry)
            return values, values

        (slopes, of_weights), (numbers, weights) = jax.jacfwd(after, has_aux=True)(jnp.zeros_like(prior))
        local = numbers, slopes, weights, of_weights
        fewest = jnp.min(details, where=details > 0, initial=1e30)  # to invert Moments.using
        return Refit(parameters.tilt, products, details**2 / fewest, *local, poses, entry, prior)

    return jax.vmap(expand)(parameters, products, details, poses)


def turn_of_frame(axes: Array, free: Array, turned: Array) -> Array:
    """Rotation vector (3,), rad, of a small rotation (3, 3), without rotations about free axes.

    The axes are the columns of a matrix (3, 3); ``free`` (3,) bool is True for free axes.
    """
    axis = axes @ free.astype(axes.dtype)
    # a rotation about one free axis may be large
    across = (axes * ~free) @ axes.T @ vee(turned)
    return jnp.where(jnp.sum(free) == 1, jnp.cross(axis, turned @ axis), across)


def _start(found: Estimate, axes: Array, centre: Array, mean: Array, entry: Table) -> Parameters:
    """Initial parameters from the identified frames; the tilt is not part of the frames and starts at 0."""

    def in_body(axes: Array, body: Array) -> Array:
        return jnp.where(body == int(AngularType.G), mean.T @ axes, axes)

    found, axes = jax.tree.map(jnp.nan_to_num, (found, axes))  # failed windows contain NaN
    angular = in_body(axes[0], found.angular.type_code)
    linear = in_body(axes[1], jnp.asarray(ORIENTATION_BODIES)[found.linear.type_code])
    turns, slides = jnp.sum(found.angular.dof), jnp.sum(found.linear.dof)
    axis = jnp.where(turns == 1, angular[:, 2], jnp.where(slides == 1, linear[:, 2], linear[:, 0]))
    # the free direction of a pin in a slot is the second column; otherwise any normal linear axis is valid
    cosines = jnp.abs(linear.T @ axis)
    across = linear[:, jnp.where(cosines[2] < 0.7, 2, jnp.argmin(cosines))]
    ground, body = mean.T @ found.universal_axes[0], found.universal_axes[1]
    second = _unit(jnp.where(entry.crossed, jnp.cross(ground, body), across - axis * (across @ axis)))
    first = jnp.where(entry.crossed, body, jnp.cross(second, axis))
    axes = jnp.stack([first, second, jnp.cross(first, second)], axis=1)
    lean = jnp.where(entry.crossed, jnp.arctan2(first @ ground, axes[:, 2] @ ground), 0)
    in_ground = jnp.asarray(POSITION_BODIES)[found.linear.type_code] == int(AngularType.G)
    origin = found.linear.position - jnp.where(in_ground, centre, 0)
    origin = _in_other_body(origin, mean, in_ground, jnp.asarray(_IN_GROUND)[entry.path])
    return Parameters(axes, origin, jnp.stack([0 * lean, lean]), jnp.where(entry.pitch, found.pitch, 0))


def _frames(
    parameters: Parameters, ground: Array, mean: Array, found: Estimate, entry: Table
) -> tuple[Array, Array]:
    """Axes (2, 3, 3) and origin (3,) in the bodies of their types; ``ground`` has the axes in the ground."""
    bodies = jnp.stack([ground, parameters.axes])
    # a universal joint does not turn about the normal of its two axes
    to_ground = jnp.where(found.angular.type_code == int(AngularType.G), mean, jnp.eye(3, dtype=mean.dtype))
    second = to_ground @ bodies[1][:, 0]
    odd = _unit(jnp.cross(to_ground @ mean.T @ bodies[0][:, 2], second))
    universal = jnp.stack([odd, second, jnp.cross(odd, second)], axis=1)
    angular = jnp.where(entry.crossed, universal, bodies[found.angular.type_code])
    linear = bodies[jnp.asarray(ORIENTATION_BODIES)[found.linear.type_code]]
    in_ground = jnp.asarray(POSITION_BODIES)[found.linear.type_code] == int(AngularType.G)
    origin = _in_other_body(parameters.origin, mean, jnp.asarray(_IN_GROUND)[entry.path], in_ground)
    return jnp.stack([angular, linear]), origin


def _unit(vector: Array) -> Array:
    return vector / jnp.sqrt(jnp.sum(vector * vector) + 1e-30)


def _in_other_body(origin: Array, mean: Array, in_ground: Array, to_ground: Array) -> Array:
    """Express an origin (3,) in the ground or the body, at the mean pose; only joints have it in both."""
    return jnp.where(in_ground == to_ground, origin, jnp.where(to_ground, mean @ origin, mean.T @ origin))
