"""Checks of what goes with an identification: its poses and their times; and windows in pieces."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import chunk_size
from reframe_jax.identification.results import Identification

__all__ = ["in_pieces", "pad_recording", "poses_of", "sample_steps"]

_SHORT = 64  # poses up to which a recording is not padded
_PIECE = 8  # chunks that one thread computes in one call


def poses_of(found: Identification, poses: ArrayLike) -> tuple[Any, bool]:
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


def sample_steps(poses: Any, times: ArrayLike | None, dt: ArrayLike | None) -> Any:
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


def pad_recording(poses: Any, steps: Any) -> tuple[Any, Any, np.ndarray | None]:
    """One recording padded to one of few lengths, so that new lengths compile nothing; and its own length.

    Short ones stay as they are, and their length is None.
    """
    count = poses.shape[0]
    if count <= _SHORT:
        return poses, steps, None
    fill = (1 << (count - 1).bit_length()) - count
    xp = jnp if isinstance(poses, jax.Array) else np
    poses = xp.concatenate([poses, xp.repeat(poses[-1:], fill, axis=0)])
    steps = np.concatenate([steps, np.repeat(steps[-1:], fill)])
    return poses, steps, np.full(1, count, np.int32)


def in_pieces(run: Callable[..., Any], tree: Any, count: int) -> Any:
    """Run N windows in pieces of few sizes, on all processors; the last piece repeats its last window.

    Args:
        run: a compiled function of the pytree, whose leaves have N as their first axis.
        tree: its argument.
        count: N.
    """
    chunk = chunk_size()
    size = chunk if count <= chunk else _PIECE * chunk
    starts = range(0, count, size)
    precise = bool(jax.dtypes.canonicalize_dtype(np.float64) == np.float64)

    def piece(start: int) -> Any:
        rows = np.minimum(np.arange(start, start + size), count - 1)
        part = slice(start, start + size) if start + size <= count else rows
        with jax.enable_x64(precise):  # JAX's settings belong to a thread
            return jax.block_until_ready(run(jax.tree.map(lambda leaf: leaf[part], tree)))

    parts = [piece(start) for start in starts[:1]]
    if len(starts) > 1:
        workers = 1 if jax.default_backend() != "cpu" else len(os.sched_getaffinity(0))
        with ThreadPoolExecutor(workers) as pool:
            parts += pool.map(piece, starts[1:])
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:count], *parts)
