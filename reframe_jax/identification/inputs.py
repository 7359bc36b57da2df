"""Check poses and times, and convert them to the arrays of the pipeline."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import in_float64, join_parts
from reframe_jax.motion.checks import MIN_VELOCITIES

__all__ = ["padded_size", "read_number", "read_numbers", "run_in_pieces", "take_poses", "take_steps"]

_SINGLE = 8  # windows up to which a program for many is not worth compiling
_FEWEST, _SHORT, _LONG = 8, 64, 4096  # poses that are padded at least; the smallest size; see padded_size
_TOO_COARSE = ("float16", "bfloat16")
_REMEDIES = {
    "M": ": give seconds, (times - times[0]) / np.timedelta64(1, 's')",
    "m": ": give seconds, dt / np.timedelta64(1, 's')",
}


def read_numbers(name: str, value: Any) -> Any:
    """Convert to an array of real numbers that JAX can use: float32, float64, or integers.

    Arrays of JAX stay as they are. Others become NumPy arrays in the byte order of the machine; those of more
    than 64 bits are rounded to float64.

    Args:
        name: of the argument, for messages.
        value: an array, or what NumPy makes one of.

    Raises:
        ValueError: for anything but real numbers, or for floats of 16 bits and less.
    """
    if not isinstance(value, jax.Array):
        if np.ma.is_masked(value):
            raise ValueError(f"{name} must not be masked: leave those entries out, or make them NaN.")
        try:
            value = np.asarray(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be an array of numbers: {error}") from error
    dtype = value.dtype
    kind = getattr(dtype, "kind", "V")  # keys of random numbers have none
    if dtype.name in _TOO_COARSE or (kind == "f" and dtype.itemsize < 4):
        raise ValueError(
            f"{name} must be float64, float32 or integers, not {dtype.name}, which keeps three digits: "
            "motion drowns in its rounding. Converting it brings nothing back."
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
    """Convert to a single real number.

    Raises:
        ValueError: for anything else.
    """
    number = read_numbers(name, value)
    if number.ndim:
        raise ValueError(f"{name} must be a number, not an array of shape {number.shape}.")
    return float(number)


def take_poses(poses: Any) -> Any:
    """Check the type and shape of poses (..., K+1, 4, 4); integers become float64.

    Raises:
        ValueError: if they are of a wrong type or shape, or too few.
    """
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
    """Compute the sample time of every step, (K,) or (..., K) in s, from times or dt.

    Args:
        poses: as :func:`take_poses` returns them.
        times: (K+1,) or (..., K+1) s, or None.
        dt: a scalar, (K,) or (..., K) s, or None.

    Raises:
        ValueError: unless exactly one of the two is given, in such a shape and of real numbers.
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
    """Differences of neighbours as floats; also of unsigned integers that fall, and of any that overflow."""
    later, earlier = times[..., 1:], times[..., :-1]
    if times.dtype.kind == "f":
        return later - earlier
    xp = jnp if isinstance(times, jax.Array) else np
    rises = later >= earlier
    # modulo 2^n, so that no difference is too large for its type
    unsigned = np.dtype(f"u{times.dtype.itemsize}")
    size = xp.where(rises, later - earlier, earlier - later).astype(unsigned).astype(float)
    return xp.where(rises, size, -size)


def padded_size(count: int) -> int:
    """Padded length of a window: 64, 256, 1024 or 4096 poses, then powers of 2.

    A program for a size takes longer to compile than thousands of poses that do not count take to run.
    """
    if count < _FEWEST:
        return count
    size = _SHORT
    while size < count:
        size *= 4 if size < _LONG else 2
    return size


def _pad_poses(poses: Any, steps: Any) -> tuple[Any, Any, bool]:
    """Pad windows to one of few lengths, so that few programs are compiled; also say if lengths are needed.

    The very shortest stay as they are.

    Args:
        poses: (..., K+1, 4, 4).
        steps: (K,) or (..., K) s.
    """
    count = poses.shape[-3]
    fill = padded_size(count) - count
    if fill:
        xp = jnp if isinstance(poses, jax.Array) else np
        poses = xp.concatenate([poses, xp.repeat(poses[..., -1:, :, :], fill, axis=-3)], axis=-3)
        xp = jnp if isinstance(steps, jax.Array) else np
        steps = xp.concatenate([steps, xp.repeat(steps[..., -1:], fill, axis=-1)], axis=-1)
    # one program for a size, whether there is something to fill or not
    return poses, steps, count >= _FEWEST


def run_in_pieces(run: Callable[..., Any], poses: Any, steps: Any, others: Any, most: int, pad: bool) -> Any:
    """Compute results for N windows in pieces of one of few sizes and lengths.

    A piece has ``most`` windows, the last one repeats its last window. Up to eight are computed one by one.

    Args:
        run: function of poses, steps, lengths (N,) or None, and others, that compiles once for a size.
        poses: (N, K+1, 4, 4).
        steps: (K,) or (N, K) s.
        others: pytree of arrays with an axis (N,) in front.
        most: windows in a piece.
        pad: whether windows are padded to one of few lengths; not if something counts from their end.
    """
    count, length = poses.shape[:2]
    padded = False
    if pad:
        poses, steps, padded = _pad_poses(poses, steps)
    size = most if count > _SINGLE else 1
    # one program, whether windows share their times or not
    xp = jnp if isinstance(steps, jax.Array) else np
    steps = xp.broadcast_to(steps, (count, steps.shape[-1]))
    lengths = np.full(size, length, np.int32) if padded else None

    def run_piece(start: int) -> Any:
        rows = np.minimum(np.arange(start, start + size), count - 1)
        part = slice(start, start + size) if start + size <= count else rows
        return run(poses[part], steps[part], lengths, jax.tree.map(lambda leaf: leaf[part], others))

    starts = range(0, count, size)
    parts = [run_piece(0)]  # which compiles
    if len(starts) > 2 and jax.default_backend() == "cpu":
        # the operations of a piece are short: XLA gives each to one processor
        wide = in_float64()  # a setting of the thread

        def run_on_thread(start: int) -> Any:
            with jax.enable_x64(wide):
                return jax.block_until_ready(run_piece(start))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            parts += pool.map(run_on_thread, starts[1:])
    else:
        parts += [run_piece(start) for start in starts[1:]]
    return join_parts(parts, count)
