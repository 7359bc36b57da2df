"""Check poses and times, convert them to arrays, and divide batches into pieces."""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import in_float64
from reframe_jax.motion.checks import MIN_VELOCITIES

_SINGLE = 8  # largest number of windows that are computed one by one, without a program for a batch
_PIECE = 16384  # padded poses in a piece of a batch: its call takes far less time than its windows
_SHORT, _LONG = 64, 4096  # padded lengths; see padded_size
_TOO_COARSE = ("float16", "bfloat16")
_REMEDIES = {
    "M": ": give seconds, (times - times[0]) / np.timedelta64(1, 's')",
    "m": ": give seconds, dt / np.timedelta64(1, 's')",
}


def read_numbers(name: str, value: Any) -> Any:
    """Convert an argument to an array of float32, float64 or integers.

    JAX arrays are returned unchanged. Other arrays, numbers and nested lists of numbers become NumPy arrays
    in the byte order of the machine; floats with more than 64 bits are rounded to float64. The name of the
    argument is for messages.

    Raises:
        ValueError: for anything but real numbers, for a masked array, or for floats of 16 bits or fewer.
    """
    if not isinstance(value, jax.Array):
        if np.ma.is_masked(value):
            raise ValueError(f"{name} must not be a masked array; remove the masked samples.")
        try:
            value = np.asarray(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be an array of numbers: {error}") from error
    dtype = value.dtype
    kind = getattr(dtype, "kind", "V")  # random keys have no kind
    if dtype.name in _TOO_COARSE or (kind == "f" and dtype.itemsize < 4):
        raise ValueError(
            f"{name} must be float64, float32 or integers, not {dtype.name}: with three digits, the rounding "
            "error hides the motion. Read the numbers again in a wider type; a conversion restores no digits."
        )
    if kind not in "iuf":
        remedy = _REMEDIES.get(kind, "")
        raise ValueError(f"{name} must be real numbers, float64, float32 or integers, not {dtype}{remedy}.")
    if isinstance(value, jax.Array):
        return value
    if kind == "f" and dtype.itemsize > 8:
        return value.astype(np.float64)
    return value.astype(dtype.newbyteorder("="), copy=False)


def read_number(name: str, value: Any) -> float:
    """Convert an argument to a single real number, as :func:`read_numbers`; refuse arrays."""
    number = read_numbers(name, value)
    if number.ndim:
        raise ValueError(f"{name} must be a number, not an array of shape {number.shape}.")
    return float(number)


def take_poses(poses: Any) -> Any:
    """Check the type and shape of poses (..., K+1, 4, 4); integers become float64.

    Raises:
        ValueError: for a wrong type or shape, or for fewer than five poses.
    """
    if isinstance(poses, str) or hasattr(poses, "poses"):
        raise ValueError("poses must be an array (K+1, 4, 4): give load_recording(path).poses.")
    poses = read_numbers("poses", poses)
    if poses.dtype.kind != "f":
        poses = poses.astype(float)
    if poses.ndim < 3 or poses.shape[-2:] != (4, 4):
        raise ValueError(f"poses must have shape (..., K+1, 4, 4), not {poses.shape}.")
    if poses.shape[-3] <= MIN_VELOCITIES:
        raise ValueError(
            f"A window needs at least {MIN_VELOCITIES + 1} poses, that is {MIN_VELOCITIES} velocities; "
            f"this one has {poses.shape[-3]}. Four touches of one point suffice for reframe-jax calibrate "
            "(rf.calibrate)."
        )
    return poses


def take_steps(poses: Any, times: Any, dt: Any) -> Any:
    """Return the durations of the steps, (K,) or (..., K) s, between poses (..., K+1, 4, 4).

    They are those of the sample times, (K+1,) or (..., K+1) s, or ``dt``, s: a scalar, (K,) or (..., K).

    Raises:
        ValueError: unless exactly one of ``times`` and ``dt`` is given, as real numbers of these shapes.
    """
    samples, batch = poses.shape[-3] - 1, poses.shape[:-3]
    if (times is None) == (dt is None):
        raise ValueError("Give either times, (..., K+1), or the sample time dt, in seconds.")
    if times is not None:
        times = read_numbers("times", times)
        if times.shape not in ((samples + 1,), (*batch, samples + 1)):
            raise ValueError(
                f"times must have shape ({samples + 1},) or {(*batch, samples + 1)}, one per pose, "
                f"not {times.shape}."
            )
        # before they are rounded: seconds since 1970 do not fit float32
        return _differences(times)
    dt = read_numbers("dt", dt)
    if dt.shape not in ((), (samples,), (*batch, samples)):
        raise ValueError(
            f"dt must be a scalar or have shape ({samples},) or {(*batch, samples)}, one per step, "
            f"not {dt.shape}."
        )
    return dt[None].repeat(samples) if dt.ndim == 0 else dt


def _differences(times: Any) -> Any:
    """Return differences of consecutive times as floats, also of unsigned or very large integers."""
    later, earlier = times[..., 1:], times[..., :-1]
    if times.dtype.kind == "f":
        return later - earlier
    xp = jnp if isinstance(times, jax.Array) else np
    rises = later >= earlier
    # modulo 2^n, so that no difference is too large for its type
    unsigned = np.dtype(f"u{times.dtype.itemsize}")
    size = xp.where(rises, later - earlier, earlier - later).astype(unsigned).astype(float)
    return xp.where(rises, size, -size)


def padded_size(count: int, single: bool) -> int:
    """Return the padded length of a window of ``count`` poses.

    Windows are padded because the compilation of a program for a new length takes longer than the computation
    with thousands of additional poses. A single window has 64, 256, 1024, 4096, or a larger power of 2; in a
    batch, many windows share one program, and the length is a power of 2 from 32.
    """
    size = _SHORT if single else _SHORT // 2
    while size < count:
        size *= 4 if single and size < _LONG else 2
    return size


def run_in_pieces(
    run: Callable[..., Any], poses: Any, steps: Any, others: Any, chunks: dict[str, int], pad: bool
) -> Any:
    """Compute results for windows in pieces of equal size, so that few programs are compiled.

    Up to eight windows are computed one by one, without a leading axis. The last piece repeats a window.

    Args:
        run: function of one window or the windows of a piece, and of the number of windows to compute, None
            for one window. Windows are their number of poses before the padding, their poses, steps and
            ``others``. JAX compiles it once for each shape of the poses.
        poses: (..., K+1, 4, 4).
        steps: (K,) or (..., K) s.
        others: pytree of arrays with the leading axes of ``poses``.
        chunks: see :func:`in_chunks`; a piece is one or more chunks.
        pad: whether to pad windows to :func:`padded_size`, with copies of their last pose and step.

    Returns:
        The results of ``run`` for all windows, with the leading axes of ``poses``; NumPy arrays for a batch
        on a CPU.
    """
    (*batch, length), count = poses.shape[:-2], math.prod(poses.shape[:-3])
    padded = padded_size(length, count <= _SINGLE) if pad else length
    # windows with equal and different times use the same program
    steps = (jnp if isinstance(steps, jax.Array) else np).broadcast_to(steps, (*batch, length - 1))

    def run_rows(rows: Any, number: Any = None) -> Any:
        before, poses, steps, others = jax.tree.map(lambda a: a[rows], windows)
        fill = np.minimum(np.arange(padded), length - 1)
        return run((before, poses.take(fill, -3), steps.take(fill[1:] - 1, -1), others), number)

    windows = np.full(batch, length, np.int32), poses, steps, others
    if not batch:
        return run_rows(...)
    windows = jax.tree.map(lambda a: a.reshape(count, *a.shape[len(batch) :]), windows)
    if count == 0:  # one window of zeros has the shapes of the result
        windows = jax.tree.map(lambda a: np.zeros((1, *a.shape[1:]), a.dtype), windows)
    if count <= _SINGLE:
        singles = jax.device_get([run_rows(row) for row in range(max(count, 1))])
        found = jax.tree.map(lambda *leaves: np.stack(leaves)[:count], *singles)
    else:
        chunk = _chunk_size(chunks, padded)
        found = _run_pieces(run_rows, count, chunk, chunk * max(1, _PIECE // (chunk * padded)))
    return found if len(batch) == 1 else jax.tree.map(lambda a: a.reshape(*batch, *a.shape[1:]), found)


def run_in_trace(
    run: Callable[..., Any], poses: jax.Array, steps: jax.Array, others: Any, chunks: dict[str, int]
) -> Any:
    """Compute results for windows inside of a trace; the arguments are those of :func:`run_in_pieces`."""
    batch = poses.shape[:-3]
    steps = jnp.broadcast_to(steps, (*batch, steps.shape[-1]))
    windows = np.full(batch, poses.shape[-3], np.int32), poses, steps, others
    return in_chunks(lambda windows: run(windows, None), chunks)(windows, None)


def _run_pieces(run_rows: Callable[[Any, Any], Any], count: int, chunk: int, size: int) -> Any:
    """Compute results for ``count`` windows in pieces of ``size`` rows, several at a time on a CPU."""
    on_cpu = jax.default_backend() == "cpu"
    # XLA runs the short operations of a piece on one processor, so threads run several pieces
    threads = (os.cpu_count() or 1) if on_cpu else 1
    step = min(size, chunk * -(-count // (chunk * threads)))
    starts = range(0, count, step)
    numbers = tuple(min(step, count - start) for start in starts)
    wide = in_float64()  # each thread has its own setting

    def run_piece(start: int, number: int) -> Any:
        with jax.enable_x64(wide):
            return run_rows(np.minimum(np.arange(start, start + size), count - 1), np.int32(number))

    if threads == 1 or len(starts) == 1:
        parts = list(map(run_piece, starts, numbers))
    else:
        run_piece(0, 0)  # compiles the program
        with ThreadPoolExecutor(threads) as pool:
            parts = list(pool.map(lambda *piece: jax.block_until_ready(run_piece(*piece)), starts, numbers))
    return _join(jax.device_get(parts), numbers, np) if on_cpu else _join_on_gpu(parts, numbers)


def _join(parts: list[Any], numbers: tuple[int, ...], xp: Any = jnp) -> Any:
    """Concatenate parts, pytrees of arrays, of which only the first ``numbers`` rows count."""
    return jax.tree.map(
        lambda *leaves: xp.concatenate([leaf[:size] for leaf, size in zip(leaves, numbers, strict=True)]),
        *parts,
    )


_join_on_gpu = jax.jit(_join, static_argnums=1)  # eagerly, every shape would be a program; NumPy has none


def _chunk_size(chunks: dict[str, int], length: int) -> int:
    """Return the number of windows in a chunk; on a GPU, there are fewer of more than ``_SHORT`` poses."""
    if (backend := jax.default_backend()) not in chunks or backend == "cpu":
        return chunks["cpu"]
    return max(1, chunks[backend] * _SHORT // max(_SHORT, 1 << (length - 1).bit_length()))


def in_chunks(function: Callable[..., Any], chunks: dict[str, int]) -> Callable[..., Any]:
    """Make a function of N windows one of windows with any leading axes, one chunk of windows after another.

    ``chunks`` has the number of windows in a chunk, by the name of the backend; on a GPU, chunks of windows
    of more than 64 poses are smaller. Windows are a pytree of arrays with the same leading axes; the first
    array has no other axes. The results have these axes too. The second argument is the number of windows to
    compute, or None for all: results of the chunks after them are zeros, without a reverse derivative.
    Further arguments are those of ``function``.
    """

    @wraps(function)
    def over(windows: Any, number: jax.Array | None, *others: Any, **static: Any) -> Any:
        def of_chunk(windows: Any) -> Any:
            return function(windows, *others, **static)

        batch = jax.tree.leaves(windows)[0].shape
        longest = max(size for leaf in jax.tree.leaves(windows) for size in (1, *leaf.shape[len(batch) :]))
        chunk, total = _chunk_size(chunks, longest), math.prod(batch)
        parts = -(-total // chunk)
        windows = jax.tree.map(lambda a: a.reshape(total, *a.shape[len(batch) :]), windows)
        if parts <= 1:
            found = of_chunk(windows)
        else:
            fill = np.minimum(np.arange(parts * chunk), total - 1)
            windows = jax.tree.map(lambda a: a[fill] if len(fill) > total else a, windows)
            windows = jax.tree.map(lambda a: a.reshape(parts, chunk, *a.shape[1:]), windows)
            used = None if number is None else (number + chunk - 1) // chunk
            found = _map_chunks(of_chunk, windows, parts, used)
            found = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:total], found)
        return jax.tree.map(lambda a: a.reshape(*batch, *a.shape[1:]), found)

    return over


def _map_chunks(of_chunk: Callable[[Any], Any], windows: Any, parts: int, number: jax.Array | None) -> Any:
    """Call a function for windows (parts, chunk, ...), and only for the first ``number`` parts if given."""
    if number is None:
        return jax.lax.map(of_chunk, windows)
    of_part = jax.jit(lambda i: of_chunk(jax.tree.map(lambda a: a[i], windows)))
    found = jax.tree.map(lambda a: jnp.zeros((parts, *a.shape), a.dtype), jax.eval_shape(of_part, number))

    def add(i: jax.Array, found: Any) -> Any:
        return jax.tree.map(lambda a, own: a.at[i].set(own), found, of_part(i))

    return jax.lax.fori_loop(0, number, add, found)
