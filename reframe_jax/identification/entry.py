"""The main entry: poses in, constraint frames out.

This module checks the input and sends the windows to the processor; what is computed is in
:mod:`reframe_jax.identification.pipeline`.
"""

import contextlib
import functools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from numpy.typing import ArrayLike

from reframe_jax.compilation import chunk_size, compiler_options, in_float64, index_leaves, traced
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.inputs import pad_recording, take_poses, take_steps
from reframe_jax.identification.options import Lag, as_dtype, check_options, lag_in_samples, make_space
from reframe_jax.identification.programs import (
    PIECE,
    identify_chunks,
    identify_compiled,
    identify_flat,
    identify_one,
)
from reframe_jax.identification.results import Identification
from reframe_jax.identification.uncompiled import check_compiled, compile_windows, identify_uncompiled
from reframe_jax.motion.checks import Status
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.norms import check_exponent
from reframe_jax.solvers import BasinHopping, FrameSteps, JointSearch, Solver, ValleySteps

__all__ = ["default_solver", "identify", "identify_piece"]

_FEWEST = 1024  # windows in a piece on an accelerator

_compiled_programs: set[Any] = set()  # that threads may run without compiling them at the same time

_VALLEY = BasinHopping(ValleySteps(6), restarts=7, hops=2, polish=1, rounds=8)
_POSITIVE = BasinHopping(ValleySteps(8), restarts=8, hops=4, polish=2)
_NEGATIVE = JointSearch(BasinHopping(FrameSteps(10), restarts=16, hops=3, polish=2), refine=ValleySteps(4))


def default_solver(norm: float = 0.0) -> BasinHopping | JointSearch:
    """The solver ``identify`` uses for an exponent of the norm."""
    exponent = check_exponent(norm)
    return _VALLEY if exponent == 0 else _POSITIVE if exponent > 0 else _NEGATIVE


def identify(
    poses: ArrayLike,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    lag: Lag = "auto",
    norm: float = 0.0,
    discretization: Discretization = "chord",
    thresholds: Thresholds | None = None,
    bounds: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    solver: Solver | None = None,
    key: jax.Array | None = None,
    compiled: bool | None = None,
) -> Identification:
    """Identify the constraint frame of one window of poses, or of every window of a batch.

    Minimises the norm of Eqs. 7 and 8 of the paper for both angular and all four linear frame types,
    takes the best type of each group, and classifies its degrees of freedom. The best type has the lowest
    norm; by default the best linear type is the one whose constrained axes are the stillest. Classes that say
    the same in all types, such as a hinge, are given in GB or BG, which know the origin best.

    Batches run on every processor; windows that lie on several devices (by a ``NamedSharding`` along
    their first axis) are identified where they are. Works under ``jit``, ``vmap`` and every kind of
    differentiation with respect to the poses. Precision is that of the input; NumPy float64 arrays are
    computed in float64 even where JAX's ``jax_enable_x64`` is off (the result is then rounded to
    float32).

    Args:
        poses: (..., K+1, 4, 4) poses of the moving body {b} in the ground {g}, in metres; K >= 4. float64 or
            float32; integers become float64.
        times: (K+1,) or (..., K+1) sample times in s, increasing. Give either ``times`` or ``dt``.
        dt: sample time in s, a scalar or (K,) or (..., K).
        lag: between the two poses that a velocity is taken from: a number of samples (int), a time in s
            (float), or ``"auto"``, the shortest at which the motion stands out of the recording's own noise
            (see :func:`reframe_jax.motion.noise.choose_lag`); one sample where the noise is as small as an
            encoder's. Chords overlap, so every pose is used; outliers and rest are left out. ``lag=1`` is the
            paper's choice: consecutive poses, each of which counts.
        norm: exponent of the power mean over the three axes, in [-inf, 2]; 0, the geometric mean, is
            the paper's. It must be a Python number.
        discretization: ``"chord"`` for measured motion, ``"left"`` for the paper's Table 3; see
            :func:`reframe_jax.motion.kinematics.linear_velocity_maps`.
        thresholds: RMS velocities above which an axis is free.
        bounds: where positions are searched, in m: half the width of a cube, or (low, high), each (3,).
            By default 1 m, and 16 m for windows whose motion points to an origin farther away, which
            ``warnings`` of the result then says. The box is centred on the mean position of {b} for frames
            fixed in the ground, and on the origin of {b} for frames fixed in the body, so the answer does not
            depend on where the ground frame happens to be.
        solver: search for the position, by default :func:`default_solver`.
        key: of the solver's random numbers; by default ``jax.random.key(0)``.
        compiled: whether programs that JAX compiles identify the windows, or NumPy, one operation after the
            other. The results are the same up to rounding. A compiled program takes tens of seconds for its
            first answer, and from then on a millisecond a window; NumPy takes about a twentieth of a second,
            always. By default the first 128 calls of a process with a single window, or up to 64, use NumPy.
            Windows under a transformation of JAX, or on a device that they were put on, are always compiled.

    Returns:
        The identification, with the leading axes of ``poses``.

    Raises:
        ValueError: if types, shapes or options are not as above; for a single window outside a trace also
            if its poses or times are unusable. In a batch such windows get a ``status`` instead.
    """
    exponent = check_exponent(norm)
    inside_a_trace = traced((poses, times, dt, lag, thresholds, bounds, key))
    array = take_poses(poses)
    check_options(thresholds, solver, discretization, key)
    solver = default_solver(exponent) if solver is None else solver
    check_compiled(compiled, solver)
    wide = not isinstance(array, jax.Array) and array.dtype == np.float64
    with jax.enable_x64(True) if wide else contextlib.nullcontext():
        steps = take_steps(array, times, dt)
        rule, samples = lag_in_samples(lag, steps, discretization)
        dtype = jax.dtypes.canonicalize_dtype(array.dtype)
        options = (
            samples,
            None if thresholds is None else jax.tree.map(lambda t: as_dtype(t, dtype), thresholds),
            make_space(bounds, dtype),
            key,
        )
        static: dict[str, Any] = {
            "rule": rule,
            "exponent": exponent,
            "discretization": discretization,
            "solver": solver,
        }
        run = partial(identify_compiled, **static)
        batch = array.shape[:-3]
        if inside_a_trace or 0 in batch:
            found = run(array, steps, *options)
        elif not compile_windows(compiled, array, *static.values()):
            found = identify_uncompiled(array, steps, *options, **static)
        elif not batch:
            found = _single(array, steps, options, static)
        elif (sharding := _sharding(array)) is not None:
            found = _on_mesh(run, array, sharding, steps, options)
        else:
            windows = array.reshape(-1, *array.shape[-3:])
            steps = steps if steps.ndim == 1 else steps.reshape(-1, steps.shape[-1])
            options = samples if np.ndim(samples) == 0 else samples.reshape(-1), *options[1:]
            program = identify_chunks if jax.default_backend() == "cpu" else identify_compiled
            found = _in_pieces(partial(program, **static), windows, steps, options)
            if len(batch) > 1:
                found = jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), found)
    if wide and not in_float64():
        found = jax.device_put(jax.tree.map(_narrow, jax.device_get(found)))
    if not batch and not inside_a_trace:
        status = Status(int(found.status_code))
        if status.failed:
            raise ValueError(status.message)
    return found


def identify_piece(poses: np.ndarray, times: np.ndarray, reach: float) -> Identification:
    """Identify a piece of a recording with the defaults. If it cannot be used, its status says so.

    Args:
        poses: (K+1, 4, 4) float64, of one window that has been checked; m.
        times: (K+1,) s.
        reach: m, half the width of the cube in which positions are searched.

    Returns:
        The identification, with its ``status``.
    """
    with jax.enable_x64(True):
        options = None, None, make_space(reach, poses.dtype), None
        static: dict[str, Any] = {
            "rule": "auto",
            "exponent": 0.0,
            "discretization": "chord",
            "solver": default_solver(),
        }
        if compile_windows(None, poses, *static.values()):
            found = _single(poses, np.diff(times), options, static)
        else:
            found = identify_uncompiled(poses, np.diff(times), *options, **static)
    return found if in_float64() else jax.device_put(jax.tree.map(_narrow, jax.device_get(found)))


def _single(poses: Any, steps: Any, options: tuple[Any, ...], static: dict[str, Any]) -> Identification:
    """Identify one recording: reduced by a program for recordings up to its length, solved by one for all.

    The evidence of all recordings has one shape, so that a new length compiles little or nothing.
    """
    count = poses.shape[0]
    poses, steps, number = pad_recording(poses, steps)
    found = identify_one(poses[None], np.asarray(steps, poses.dtype), number, *options, **static)
    if number is None:
        return found
    # by NumPy: for JAX, to take a part of an array is another program
    counted = found.counted
    device = counted.sharding if counted.committed else None
    return replace(found, counted=jax.device_put(np.asarray(counted)[:count], device))


def _narrow(leaf: np.ndarray) -> np.ndarray:
    return leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf


def _in_pieces(
    run: partial[Identification], windows: Any, steps: Any, options: tuple[Any, ...]
) -> Identification:
    """Run N windows in pieces of one of few sizes, so that batches of every size share compilations.

    The pieces are spread over all processors. The last one is filled with its last window.
    """
    count = len(windows)
    size, precise = _piece_size(count), in_float64()
    lag, *others = options

    def piece(start: int) -> Identification:
        rows = np.minimum(np.arange(start, start + size), count - 1)
        whole = rows[-1] - rows[0] == size - 1
        part = slice(start, start + size) if whole else rows
        with jax.enable_x64(precise):  # JAX's settings belong to a thread
            own = steps if steps.ndim == 1 else steps[part], lag if np.ndim(lag) == 0 else lag[part]
            found = run(windows[part], *own, *others)
            return jax.block_until_ready(found)

    starts = range(0, count, size)
    ranks = steps.ndim, np.ndim(lag)
    program = (size, windows.shape[1:], windows.dtype, ranks, precise, *run.keywords.values())
    alone = 1 if len(starts) == 1 or program not in _compiled_programs else 0
    pieces = [piece(start) for start in starts[:alone]]  # two threads would both compile
    _compiled_programs.add(program)
    if len(starts) > alone:
        with ThreadPoolExecutor(_workers()) as pool:
            pieces += pool.map(piece, starts[alone:])
    if len(pieces) == 1 and len(pieces[0].status_code) == count:
        return pieces[0]
    return _join(pieces, count=count)


def _piece_size(count: int) -> int:
    """Windows in a piece: on a processor one of two sizes, on an accelerator a power of two for the few."""
    chunk = chunk_size()
    if count > chunk:
        return PIECE * chunk
    if jax.default_backend() == "cpu":
        return chunk
    return min(chunk, max(_FEWEST, 1 << (count - 1).bit_length()))


def _sharding(poses: Any) -> NamedSharding | None:
    """How the windows are spread over a mesh of devices; None if they are not."""
    if not isinstance(poses, jax.Array):
        return None
    sharding = poses.sharding
    spread = isinstance(sharding, NamedSharding) and any(axis is not None for axis in sharding.spec)
    if len(sharding.device_set) == 1 and not spread:
        return None
    if not isinstance(sharding, NamedSharding) or any(axis is not None for axis in sharding.spec[1:]):
        raise ValueError(
            "Windows on several devices must be spread along their first axis alone, by a NamedSharding; "
            f"these have {sharding}."
        )
    return sharding


def _on_mesh(
    run: partial[Identification],
    poses: jax.Array,
    sharding: NamedSharding,
    steps: Any,
    options: tuple[Any, ...],
) -> Identification:
    """Every device of the mesh identifies the windows it holds, in pieces; nothing travels between them."""
    axis = (*sharding.spec, None)[0]
    program = partial(_program_for_mesh, sharding.mesh, axis)
    lag, *others = options
    each = NamedSharding(sharding.mesh, PartitionSpec(axis))
    own_steps, own_lag = steps.ndim > 1, np.ndim(lag) > 0
    steps = jax.device_put(steps, each) if own_steps else steps
    lag = jax.device_put(lag, each) if own_lag else lag
    count = sharding.shard_shape(poses.shape)[0]
    windows_in_row = math.prod(poses.shape[1:-3])
    size = max(1, _piece_size(count * windows_in_row) // windows_in_row)
    # by a program of its own: within one that identifies, XLA would transpose all poses instead of a piece
    rows = program(_rows, (True, False), size=size)
    identify_rows = program(identify_flat, (True, own_steps, own_lag, False, False, False), **run.keywords)
    parts = []
    for start in range(0, count, size):
        own = rows(steps, start) if own_steps else steps, rows(lag, start) if own_lag else lag
        parts.append(jax.block_until_ready(identify_rows(rows(poses, start), *own, *others)))
    return program(_join, (True,), count=count)(parts)


@functools.cache
def _program_for_mesh(
    mesh: Mesh, axis: Any, function: Callable[..., Any], spread: tuple[bool, ...], **static: Any
) -> Callable[..., Any]:
    """A function that each device runs on its part of those arguments that are spread."""
    specs = tuple(PartitionSpec(axis) if argument else PartitionSpec() for argument in spread)
    run = jax.shard_map(
        partial(function, **static),
        mesh=mesh,
        in_specs=specs,
        out_specs=PartitionSpec(axis),
        check_vma=False,
    )
    return jax.jit(run, compiler_options=compiler_options(mesh.devices.flat[0].platform))


def _rows(array: jax.Array, start: jax.Array, *, size: int) -> jax.Array:
    """So many rows; the last one again where there are no more."""
    return jnp.take(array, start + jnp.arange(size), axis=0, mode="clip")


def _join(parts: list[Identification], *, count: int) -> Identification:
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts) if len(parts) > 1 else parts[0]
    return index_leaves(joined, slice(count))


def _workers() -> int:
    """Threads to use: the processors this process may run on, or one to feed an accelerator."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
