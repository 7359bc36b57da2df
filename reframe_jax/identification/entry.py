"""The main function, ``identify``: check poses and options, run compiled programs, and return the results."""

import contextlib
import warnings
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from reframe_jax.compilation import COMPILER_OPTIONS, in_float64, inside_trace, narrow
from reframe_jax.identification import pipeline
from reframe_jax.identification.cautions import Caution
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.inputs import run_in_pieces, run_in_trace, take_poses, take_steps
from reframe_jax.identification.options import Options, Scales, check_options
from reframe_jax.identification.pipeline import CHUNK, Arrays, Method
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import Status, is_rigid
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.norms import check_exponent
from reframe_jax.recordings.continuity import is_unordered
from reframe_jax.recordings.lost import find_lost_poses
from reframe_jax.recordings.recording import name_rows
from reframe_jax.solvers import Solver


def identify(
    poses: "ArrayLike",
    *,
    times: "ArrayLike | None" = None,
    dt: "ArrayLike | None" = None,
    scales: Scales = "auto",
    assume: str | None = None,
    norm: float = 0.0,
    discretization: Discretization = "chord",
    thresholds: Thresholds | None = None,
    bounds: "ArrayLike | None" = None,
    solver: Solver | None = None,
    key: jax.Array | None = None,
) -> Identification:
    """Identify the constraint of a moving body from its poses, for one window or for every window of a batch.

    First, the norm of the paper (Eqs. 7 and 8), extended to several time scales, gives the best origin for
    every linear frame type. From these origins, every constraint of a table is fitted to the second moments
    of the motion. The result is the most probable constraint: its frame, and which axes are constrained or
    free. The options ``scales=1``, ``discretization="left"`` and ``thresholds=Thresholds()`` select the
    paper's method.

    The function works under ``jit`` and ``vmap``, and is differentiable with respect to the poses. It
    computes in the precision of the input; NumPy float64 arrays are computed in float64 also if JAX's
    ``jax_enable_x64`` is off, and the result is then rounded to float32. Windows that a ``NamedSharding``
    distributes over several devices along their first axis are identified on these devices.

    Args:
        poses: (..., K+1, 4, 4) poses of the moving body {b} in the ground {g}, m; K >= 4. float64 or float32;
            integers become float64.
        times: (K+1,) or (..., K+1) increasing sample times, s. Give either ``times`` or ``dt``.
        dt: time between two poses, s: a scalar, (K,) or (..., K).
        scales: time scales as numbers of samples, powers of two. At each scale, the means of consecutive
            blocks of this number of samples are compared. ``"auto"`` uses all scales at which the motion
            exceeds the noise, and leaves out outliers. 1 is the paper's choice: differences of consecutive
            poses, outliers included. ``"mean"`` compares all poses with their mean and needs no order;
            ``"auto"`` does the same for a single window of poses without order, such as separate touches or
            shuffled rows. Probabilities and amplitudes are those of the whole recording at any scales.
        assume: name of a known constraint ("hinge", "ball", "K", "Screw joint"). The result is the best frame
            of this constraint; ``probability`` is still its probability among all constraints.
        norm: exponent of the power mean over the three axes, in [-inf, 2], a Python number. 0 is the
            geometric mean, as in the paper. With another exponent, ``solver`` searches the origins with
            ``scales=1``.
        discretization: ``"chord"`` for measured motion, ``"left"`` for the paper's Table 3; see
            :func:`reframe_jax.motion.kinematics.linear_velocity_maps`.
        thresholds: RMS velocities above which an axis is free. By default, probabilities decide.
        bounds: half the width of the cube in which origins are searched, m. By default 2 m, or twice the
            extent of the motion if that is more. The cube is centred on the mean position of {b} for origins
            fixed in the ground, and on the origin of {b} for origins fixed in the body.
        solver: search for the origins with ``scales=1``, such as :class:`BasinHopping`.
        key: JAX random key of the solver; ``jax.random.key(0)`` by default.

    Returns:
        The identification, with the leading axes of ``poses``. For a single window, ``warnings`` lists
        reasons to doubt the result, for example that the poses have no order.

    Warns:
        UserWarning: if tracking seems lost in some poses of a single window, or if float32 is too coarse for
            the positions of results in float64; not inside a trace.

    Raises:
        ValueError: for a wrong type, shape or option. Also for a single window outside a trace whose poses or
            times are unusable; in a batch, such a window gets a ``status`` instead.
    """
    array = take_poses(poses)
    inside_a_trace = inside_trace((poses, times, dt, thresholds, bounds, key))
    single_window = array.ndim == 3 and not inside_a_trace
    unordered = single_window and is_unordered(np.asarray(array, dtype=float))
    options = Options(scales, assume, norm, discretization, thresholds, bounds, solver, key)
    if unordered and not options.by_steps and isinstance(scales, str) and scales == "auto":
        options = options._replace(scales="mean")
    found = identify_unchecked(array, times, dt, options, inside_a_trace)
    if unordered:
        found = replace(found, warning_codes=found.warning_codes | int(Caution.UNORDERED))
    if single_window:
        _warn_of_lost_rows(np.asarray(array, dtype=float), times)
    return found


def identify_unchecked(
    poses: Any, times: Any, dt: Any, options: Options, inside_a_trace: bool = False
) -> Identification:
    """Identify as :func:`identify` does, without the checks for poses without order and for lost tracking."""
    _, _, norm, discretization, thresholds, _, solver, key = options
    exponent = check_exponent(norm)
    array = take_poses(poses)
    samples, reach, allowed = check_options(options, array.shape[-3])
    wide = not inside_a_trace and not isinstance(array, jax.Array) and array.dtype == np.float64
    with jax.enable_x64(True) if wide else contextlib.nullcontext():
        samples = np.int32(1) if samples < 0 and options.by_steps else samples
        dtype = jax.dtypes.canonicalize_dtype(array.dtype)
        steps = take_steps(array, times, dt).astype(dtype)
        level = None if thresholds is None else jax.tree.map(lambda t: jnp.asarray(t, dtype), thresholds)
        reach = np.asarray(np.nan, dtype) if reach is None else jnp.asarray(reach, dtype)
        arrays = Arrays(reach, level, key, allowed, samples)
        method = Method(bool(samples == 1), exponent, discretization, solver)
        program = pipeline.identify_windows if thresholds is None else pipeline.identify_by_thresholds
        run = partial(program, arrays, method=method)
        if inside_a_trace:
            found = run_in_trace(run, array, steps, None, CHUNK)
        elif array.ndim > 3 and _is_distributed(array):
            found = _on_mesh(array, steps, arrays, method)
        else:
            # velocities of single steps must not see the padding
            found = run_in_pieces(run, array, steps, None, CHUNK, not (samples == 1 or options.by_steps))
            if array.ndim > 3:
                found = replace(found, counted=found.counted[..., : array.shape[-3]])
    if inside_a_trace:
        return found
    if wide and not in_float64():
        _warn_of_rounding(found)
    found = narrow(found)
    if array.ndim > 3:
        return found
    status = Status(int(found.status_code))
    if status.failed:
        raise ValueError(status.message + name_bad_rows(status, np.asarray(array), np.asarray(steps)))
    # without the padding; NumPy needs no program for every length
    return replace(found, counted=jax.device_put(np.asarray(found.counted)[: array.shape[0]]))


def _warn_of_lost_rows(poses: np.ndarray, times: Any) -> None:
    """Warn of rows of poses (K+1, 4, 4) in which tracking was lost."""
    reasons = find_lost_poses(poses, None if times is None else np.asarray(times, dtype=float))
    lost = np.flatnonzero(reasons != "")
    if len(lost):
        warnings.warn(
            f"Tracking seems lost in {name_rows('row', lost)} of poses, counted from 0 "
            f"({', '.join(sorted({*reasons[lost]}))}). Remove these rows and their times, as "
            "load_recording does; reframe_jax.recordings.lost.find_lost_poses returns them.",
            stacklevel=3,
        )


def name_bad_rows(status: Status, poses: np.ndarray, steps: np.ndarray) -> str:
    """Name the poses (K+1, 4, 4) and steps (K,), s, that cause a status; empty if no single row does."""
    late = np.append(False, ~(steps > 0))
    finite = np.isfinite(poses).all(axis=(1, 2)) & np.append(True, np.isfinite(steps))
    bad = {Status.NOT_FINITE: ~finite, Status.NOT_A_POSE: ~is_rigid(poses), Status.TIMES_NOT_INCREASING: late}
    rows = np.flatnonzero(bad.get(status, False))
    return f" See {name_rows('row', rows)}, counted from 0." if len(rows) else ""


def _warn_of_rounding(found: Identification) -> None:
    """Warn if the positions of a result in float64 will be rounded to float32 by more than their noise."""
    error = np.finfo(np.float32).eps * np.abs(np.asarray(found.linear.position)).max(axis=-1, initial=0)
    if np.any(error > np.maximum(found.noise.position, 1e-5)):  # m; trackers are no better than 10 um
        advice = 'Subtract an offset, or call jax.config.update("jax_enable_x64", True).'
        warnings.warn(f"JAX rounds positions to {1e3 * np.nanmax(error):.2g} mm. {advice}", stacklevel=4)


def _is_distributed(poses: Any) -> bool:
    """Whether a sharding distributes windows over devices, or over a mesh of one device."""
    sharding = poses.sharding if isinstance(poses, jax.Array) else None
    over_mesh = isinstance(sharding, NamedSharding) and any(axis is not None for axis in sharding.spec)
    return over_mesh or (sharding is not None and len(sharding.device_set) > 1)


def _on_mesh(poses: jax.Array, steps: Any, arrays: Arrays, method: Method) -> Identification:
    """Identify windows on the devices that hold them, without communication between devices."""
    sharding = poses.sharding
    if not isinstance(sharding, NamedSharding) or any(axis is not None for axis in sharding.spec[1:]):
        raise ValueError(
            "Windows on several devices must be distributed by a NamedSharding along their first axis only, "
            f"not by {sharding}."
        )
    axis = (*sharding.spec, None)[0]
    own = steps.ndim > 1
    if own:
        steps = jax.device_put(steps, NamedSharding(sharding.mesh, PartitionSpec(axis)))
    return _program_for_mesh(sharding.mesh, axis, own, method)(poses, steps, arrays)


@cache
def _program_for_mesh(mesh: Mesh, axis: Any, own_steps: bool, method: Method) -> Any:
    """Compile ``identify_windows`` for windows that are distributed over a mesh of devices."""

    def of_device(poses: jax.Array, steps: jax.Array, arrays: Arrays) -> Any:
        run = partial(pipeline.identify_windows, arrays, method=method)
        return run_in_trace(run, poses, steps, None, CHUNK)

    whole, part = PartitionSpec(), PartitionSpec(axis)
    specs = part, part if own_steps else whole, whole
    run = jax.shard_map(of_device, mesh=mesh, in_specs=specs, out_specs=part, check_vma=False)
    return jax.jit(run, compiler_options=COMPILER_OPTIONS)
