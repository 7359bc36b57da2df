"""What errors of measured poses look like along an axis that is constrained: densities, without thresholds.

Motions are in logarithms of the noise propagated to the axis. Two recordings of three have noise alone; the
others have slow errors besides, 2 to 64 times as large as the noise of single poses, the larger the rarer,
of a size that all axes of the recording share. Who uses these densities sums over the sizes, so that no
threshold is needed: each axis that shows noise alone speaks against slow errors.
"""

from math import log, pi
from typing import NamedTuple

import jax

from reframe_jax.arrays import jnp

__all__ = [
    "LARGEST",
    "ROTATION_ERROR_SHARE",
    "UNRELATED",
    "ErrorSizes",
    "error_sizes",
    "log_normal",
    "of_errors",
    "of_noise",
    "of_rotation_error",
    "of_slow_errors",
    "spread_of_noise",
]

LARGEST = 1e6
"""Noises that a free axis goes, at most; beyond it noise is rounding, of each group its own."""
UNRELATED = 0.7
"""Exponent of the distribution of the share of a motion that another motion does not explain."""
ROTATION_ERROR_SHARE = 0.2
"""How often an axis shows an error of the measured rotation where there are slow errors."""

_WHITE_SHARE = 2 / 3  # of recordings have noise alone
_STEPS = 6  # between no slow errors and the largest
_MOST = log(64.0)  # slow errors at most, in logarithms of noises of single poses
_LIKELY = log(8.0)  # multiples up to this one are equally likely
_RARER = 0.8  # standard deviation, in logarithms, of their decline beyond
_SPREAD = 0.8  # of constrained axes about their multiple
_SILENT_SHARE = 0.2  # of constrained axes that show noise alone although there are slow errors
_MISFIT = 0.15  # of the logarithm of an axis that shows noise alone, for what the noise model misses
_GAIN, _GAIN_SPREAD = 0.1, 0.7  # error of measured rotation, over the rotation, and its logarithm's spread


class ErrorSizes(NamedTuple):
    """Sizes that the errors of a recording may have.

    Of shape (M, ...) each, with as many axes behind the first as the motions that they are compared with.

    Attributes:
        multiples: logarithms of multiples of the noise.
        white_only: which of them is noise alone.
        weights: logarithms of how often they occur.
    """

    multiples: jax.Array
    white_only: jax.Array
    weights: jax.Array


def error_sizes(share: jax.Array, axes: int) -> ErrorSizes:
    """Sizes that the errors of recordings have.

    Args:
        share: (...) of the noise of single poses that averaging has left. Slow errors are of the order of the
            noise of single poses, and averaging leaves them as they are.
        axes: of the motions that are compared with them; the last ones are those of ``share``.
    """
    single = -jnp.log(share)[(None,) * (1 + axes - share.ndim)]  # a noise of a single pose
    step = jnp.arange(_STEPS + 1, dtype=share.dtype).reshape(-1, *[1] * axes)
    multiples, white_only = step / _STEPS * (_MOST + single), step == 0
    rarer = jnp.square(jnp.maximum(multiples - single - _LIKELY, 0) / _RARER) / 2
    slow = log((1 - _WHITE_SHARE) / _STEPS) - rarer
    return ErrorSizes(multiples, white_only, jnp.where(white_only, log(_WHITE_SHARE), slow))


def spread_of_noise(samples: jax.Array) -> jax.Array:
    """Standard deviation of the logarithm of the RMS of noise alone in so many independent samples."""
    return jnp.sqrt(1 / (2 * samples) + _MISFIT**2)


def of_noise(y: jax.Array, spread: jax.Array | float, white_only: jax.Array | bool) -> jax.Array:
    """Logarithm of the density of noise alone: all there is, or now and then although there are slow errors.

    Args:
        y: (...) logarithm of the motion, in noises.
        spread: (...) see :func:`spread_of_noise`.
        white_only: (M, ...) see :class:`ErrorSizes`.
    """
    silent = log_normal(jnp.maximum(y, 0), 0.0, spread)[None]
    return silent + jnp.where(white_only, 0, log(_SILENT_SHARE))


def of_errors(y: jax.Array, sizes: ErrorSizes, spread: jax.Array) -> jax.Array:
    """Logarithm of the density of errors, (M, ...).

    Args:
        y: (...) logarithm of the motion, in noises.
        sizes: of errors.
        spread: (...) see :func:`spread_of_noise`.
    """
    white_only = sizes.white_only
    silent = of_noise(y, spread, white_only)
    slow = of_slow_errors(y, sizes) + log(1 - _SILENT_SHARE)
    return jnp.where(white_only, silent, jnp.logaddexp(slow, silent))


def of_slow_errors(y: jax.Array, sizes: ErrorSizes) -> jax.Array:
    """Logarithm of the density of slow errors that are there, (M, ...), of motions (...) as above."""
    return log_normal(y[None], sizes.multiples, _SPREAD)


def of_rotation_error(y: jax.Array, gain: jax.Array) -> jax.Array:
    """Logarithm of the density of what an error of the measured rotation makes along an axis, (1, ...).

    Args:
        y: (...) logarithm of the motion, in noises.
        gain: (...) what all of the measured rotation would make there, in noises.
    """
    return log_normal(y, jnp.log(jnp.maximum(_GAIN * gain, 1e-9)), _GAIN_SPREAD)[None]


def log_normal(x: jax.Array, mean: jax.Array | float, deviation: jax.Array | float) -> jax.Array:
    """Logarithm of the normal density."""
    return -jnp.square((x - mean) / deviation) / 2 - jnp.log(deviation * (2 * pi) ** 0.5)
