"""Convert the arguments of a user to windows: check poses and times, pad, and divide into chunks."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import in_float64, inside_trace, jit_pair, traced
from reframe_jax.identification.cautions import Caution
from reframe_jax.identification.inputs import run_in_pieces, take_poses, take_steps
from reframe_jax.identification.options import Scales, take_scales
from reframe_jax.identification.results import Identification
from reframe_jax.uncertainty.refit import Estimate, estimate_of, prepare

_CHUNK = {"cpu": 8, "gpu": 1024}  # windows per chunk, so that the moments of all parts fit into memory


def over_windows(
    function: Callable[..., Any],
    found: Identification,
    poses: ArrayLike,
    times: ArrayLike | None,
    dt: ArrayLike | None,
    scales: Scales,
    **static: Any,
) -> Any:
    """Call a function of N windows for the windows of an identification, single, many or traced.

    The arguments of the function are the results of :func:`.refit.prepare`, and the keywords ``scales`` and
    ``static``; it must be defined at module level, so that it compiles only once. Poses, times, dt and scales
    are those of the user. The result is that of the function, with the leading axes of ``found`` in place of
    the axis of windows.

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
        estimate = estimate_of(found, array.dtype)
        tracing = inside_trace((array, steps, estimate))
        program = _program_in_trace if tracing else _program
        run = partial(program, function=function, scales=take_scales(scales, array.shape[-3]), **static)
        batch = array.shape[:-3]
        steps = (np if wide else jnp).broadcast_to(steps, (*batch, array.shape[-3] - 1))
        array, steps, estimate = jax.tree.map(
            lambda leaf: leaf.reshape((-1, *leaf.shape[len(batch) :])), (array, steps, estimate)
        )
        if tracing:
            result = run(array, steps, None, estimate)
        else:
            most = _CHUNK.get(jax.default_backend(), 256)
            result = run_in_pieces(run, array, steps, estimate, most, True)
        result = jax.tree.map(lambda leaf: leaf.reshape((*batch, *leaf.shape[1:])), result)
    if wide and not in_float64():
        return jax.device_put(jax.tree.map(_narrow, jax.device_get(result)))
    return result


def _run(
    poses: Any, steps: Any, count: Any, found: Estimate, *, function: Any, scales: Any, **static: Any
) -> Any:
    with jax.default_matmul_precision("highest"):
        return function(*prepare(poses, steps, count, found, scales), scales=scales, **static)


_program, _program_in_trace = jit_pair(_run, ("function", "scales", "parts"))


def _narrow(leaf: Any) -> Any:
    return leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf
