"""From what a user gives to windows: checks of poses and times, padding, and pieces on all processors."""

import contextlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import chunk_size, compiler_options, in_float64, traced
from reframe_jax.identification.inputs import pad_recording
from reframe_jax.identification.results import Identification, PoseNoise
from reframe_jax.identification.uncompiled import check_compiled, compile_windows, compute_uncompiled
from reframe_jax.uncertainty.paths import Estimates, estimates_of

__all__ = ["WindowFunction", "over_windows"]

WindowFunction = Callable[[jax.Array, Estimates, jax.Array, jax.Array | None], Any]
"""Of poses (N, K+1, 4, 4), what was found, sample times (K,) or (N, K), and lengths (N,) or None."""

_AT_ONCE = 8  # windows on a CPU: their sensitivities to all poses fill a core's second cache


def _poses_of(found: Identification, poses: ArrayLike) -> tuple[Any, bool]:
    """The poses as a floating array, and whether they are to be computed in float64.

    Raises:
        ValueError: if they cannot be those that were identified.
    """
    array: Any = poses if isinstance(poses, jax.Array) else np.asarray(poses)
    if not np.issubdtype(array.dtype, np.floating):
        array = array.astype(float)
    expected = (*np.shape(found.counted), 4, 4)
    if array.shape != expected:
        raise ValueError(f"poses must be those that were identified, of shape {expected}, not {array.shape}.")
    return array, not isinstance(poses, jax.Array) and array.dtype == np.float64


def _sample_steps(poses: Any, times: ArrayLike | None, dt: ArrayLike | None) -> Any:
    """Sample time of every step in s, (K,) or (..., K) with the batch axes of the poses.

    Raises:
        ValueError: unless exactly one of ``times`` and ``dt`` is given, in a shape that fits.
    """
    if (times is None) == (dt is None):
        raise ValueError("Give either times, (..., K+1), or the sample time dt, in seconds.")
    batch, samples = poses.shape[:-3], poses.shape[-3] - 1
    name, value, number = ("times", times, samples + 1) if dt is None else ("dt", dt, samples)
    array: Any = value if isinstance(value, jax.Array) else np.asarray(value, float)
    shapes = [(number,), (*batch, number)][: 2 if batch else 1] + ([()] if name == "dt" else [])
    if array.shape not in shapes:
        listed = " or ".join(map(str, shapes))
        raise ValueError(f"{name} must have the shape {listed}, not {array.shape}.")
    if name == "times":
        array = array[..., 1:] - array[..., :-1]
    elif array.ndim == 0:
        array = array[None].repeat(samples)
    return array.astype(poses.dtype)


def over_windows(
    function: WindowFunction,
    found: Identification,
    poses: ArrayLike,
    times: ArrayLike | None,
    dt: ArrayLike | None,
    noise: PoseNoise | None = None,
    compiled: bool | None = None,
) -> Any:
    """Call a function of N windows for the windows of an identification, single, many or traced.

    Args:
        function: defined in a module, so that it compiles once.
        found: identification of one window or a batch.
        poses: of these windows, as the user gave them.
        times: s, or None.
        dt: s, or None.
        noise: of the poses; that of ``found`` by default.
        compiled: as for :func:`reframe_jax.identify`.

    Returns:
        What the function returns, with the leading axes of ``found`` in place of that of the windows.

    Raises:
        ValueError: if the poses cannot be those of ``found``, or their times do not fit.
    """
    check_compiled(compiled)
    array, wide = _poses_of(found, poses)
    narrow = wide and not in_float64()
    with jax.enable_x64(True) if wide else contextlib.nullcontext():
        steps = _sample_steps(array, times, dt)
        estimates = estimates_of(found, noise, array.dtype)
        inside_a_trace = traced((array, steps, estimates))
        if not inside_a_trace and not compile_windows(compiled, array, function):

            def of_few(poses: Any, steps: Any, found: Estimates) -> Any:
                return function(poses, found, steps, None)

            result = compute_uncompiled(of_few, array.shape[:-3], array, steps, estimates)
        elif array.ndim == 3 and not inside_a_trace:
            result = _single(function, array, steps, estimates)
        else:
            result = _batch(function, array, steps, estimates, inside_a_trace)
    return jax.device_put(jax.tree.map(_narrow, jax.device_get(result))) if narrow else result


def _narrow(leaf: Any) -> Any:
    """A NumPy array in 32 bits, made on the host: one program serves both settings of JAX."""
    kinds = {np.dtype(np.float64): np.float32, np.dtype(np.int64): np.int32}
    return leaf.astype(kinds.get(leaf.dtype, leaf.dtype))


def _single(function: WindowFunction, poses: Any, steps: Any, found: Estimates) -> Any:
    poses, steps, count = pad_recording(poses, steps)
    window = jax.tree.map(lambda leaf: leaf[None], (poses, found.padded(len(poses))))
    return _only_piece((*window, None), steps, count, function=function)


def _batch(function: WindowFunction, poses: Any, steps: Any, found: Estimates, inside_a_trace: bool) -> Any:
    batch = poses.shape[:-3]
    shared, own = (steps, None) if steps.ndim == 1 else (None, steps)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(batch) :]), (poses, found, own))
    if inside_a_trace:
        result = function(flat[0], flat[1], steps if own is None else flat[2], None)
    else:
        run = partial(_piece, shared=shared, count=None, function=function)
        result = _in_pieces(run, flat, _order(flat[1]))
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), result)


def _order(found: Estimates) -> np.ndarray:
    """Windows of one kind after each other: what a chunk has no window of is not computed."""
    turning = np.sum(found.angular_dof, axis=-1)
    kinds = found.refined, turning, found.angular_type, found.linear_type, np.asarray(found.lag) > 1
    return np.lexsort([np.asarray(kind) for kind in kinds])


def _chunks(
    inputs: tuple[jax.Array, Estimates, jax.Array | None],
    shared: jax.Array | None,
    count: jax.Array | None,
    *,
    function: WindowFunction,
) -> Any:
    """The function of N windows, chunk by chunk; sample times are those of each window, or shared."""

    def run(part: tuple[jax.Array, Estimates, jax.Array | None]) -> Any:
        poses, found, steps = part
        own = shared if steps is None else steps
        assert own is not None
        return function(poses, found, own, count)

    chunk, size = chunk_size(), len(inputs[0])
    if jax.default_backend() == "cpu":
        chunk = min(chunk, _AT_ONCE)
    if size <= chunk:
        return run(inputs)
    split = jax.tree.map(lambda leaf: leaf.reshape(-1, chunk, *leaf.shape[1:]), inputs)
    return jax.tree.map(lambda leaf: leaf.reshape(size, *leaf.shape[2:]), jax.lax.map(run, split))


_piece = jax.jit(_chunks, static_argnames="function", compiler_options=compiler_options())


@partial(jax.jit, static_argnames="function", compiler_options=compiler_options(single=True))
def _only_piece(*arguments: Any, function: WindowFunction) -> Any:
    """The function of a single window, without its axis."""
    return jax.tree.map(lambda leaf: leaf[0], _chunks(*arguments, function=function))


def _in_pieces(run: Callable[..., Any], tree: Any, order: np.ndarray) -> Any:
    """Run N windows in pieces of one size, on all processors; the last piece repeats its last window.

    Args:
        run: a compiled function of the pytree, whose leaves have N as their first axis.
        tree: its argument.
        order: (N,) in which to run them.
    """
    size, count = chunk_size(), len(order)
    starts = range(0, count, size)
    precise = in_float64()

    def piece(start: int) -> Any:
        rows = order[np.minimum(np.arange(start, start + size), count - 1)]
        with jax.enable_x64(precise):  # JAX's settings belong to a thread
            return jax.block_until_ready(run(jax.tree.map(lambda leaf: leaf[rows], tree)))

    parts = [piece(start) for start in starts[:1]]
    if len(starts) > 1:
        workers = 1 if jax.default_backend() != "cpu" else len(os.sched_getaffinity(0))
        with ThreadPoolExecutor(workers) as pool:
            parts += pool.map(piece, starts[1:])
    back = np.argsort(order)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[back], *parts)
