"""Warnings: reasons to doubt the result of a window, as codes for a batch and sentences for one window."""

from enum import IntFlag

import jax
import jax.numpy as jnp

from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.explanation import in_brackets
from reframe_jax.tuning import EVIDENCE

_FEW = 12  # largest number of velocities at which many windows are identified wrongly
_CLOSE = 1.5  # largest ratio of a velocity to a threshold, or its inverse, at which they count as close


class Caution(IntFlag):
    """Reasons to doubt a result, as bits of ``Identification.warning_codes``."""

    FEW_VELOCITIES = 1
    """The window has so few velocities that several constraints fit them."""
    CLOSE_ANGULAR_1 = 16
    """The angular velocity about the first axis of the angular frame is close to its threshold."""
    CLOSE_ANGULAR_2 = 32
    CLOSE_ANGULAR_3 = 64
    CLOSE_LINEAR_1 = 128
    """The velocity along the first axis of the linear frame is close to its threshold."""
    CLOSE_LINEAR_2 = 256
    CLOSE_LINEAR_3 = 512
    IMPROBABLE = 1024
    """The probability of the reported name is below 1/2."""
    IMPROBABLE_ASSUMED = 4096
    """The probability of the constraint that the caller assumes is below 1/2."""
    UNORDERED = 2048
    """The poses are not in the order of a motion, such as separate touches or shuffled rows."""
    NOISY_SCALE = 8192
    """The motion exceeds the noise by less than ``above_noise`` at a time scale that the caller chose."""


def caution_codes(
    velocities: jax.Array,
    rms: tuple[jax.Array, jax.Array],
    thresholds: Thresholds | None,
    marks: dict[Caution, jax.Array],
) -> jax.Array:
    """Collect the warnings of a window in one code, () int32, with the bits of :class:`Caution`.

    ``velocities`` () counts the steps between the poses of the window without outliers, ``rms`` has the RMS
    velocities along the axes of the angular frame, (3,) rad/s, and of the linear frame, (3,) m/s. The
    thresholds are None if probabilities decide. ``marks`` () bool states whether other warnings apply.
    """
    marked = {Caution.FEW_VELOCITIES: velocities <= _FEW, **marks}
    if thresholds is not None:
        first = Caution.CLOSE_ANGULAR_1, Caution.CLOSE_LINEAR_1
        for code, speeds, level in zip(first, rms, (thresholds.angular, thresholds.linear), strict=True):
            close = (speeds > level / _CLOSE) & (speeds < level * _CLOSE)
            marked |= {Caution(code << axis): close[axis] for axis in range(3)}
    codes = jnp.zeros((), jnp.int32)
    for caution, true in marked.items():
        codes = codes | jnp.where(true, jnp.int32(caution), 0)
    return codes


def caution_sentences(
    code: int, velocities: int, speeds: tuple[list[float], list[float]], probability: float
) -> list[str]:
    """Return the warnings of one window as sentences, from the code and the numbers of :func:`caution_codes`.

    The speeds are its ``rms``, and the probability is that of the name.
    """
    found = Caution(code)
    stated = in_brackets(probability)
    sentences = []
    if Caution.FEW_VELOCITIES in found:
        sentences.append(
            f"The window has only {velocities + 1} poses ({velocities} steps): with {_FEW} steps or fewer, "
            "many windows are identified wrongly. Use longer windows. For separate touches of one point, use "
            "reframe-jax calibrate (rf.calibrate)."
        )
    if Caution.UNORDERED in found:
        sentences.append(
            "The poses are not in the order of a motion: consecutive poses are as far apart as any two "
            "poses. With scales='auto', identify compares all poses with their mean, which needs no order. "
            "For separate touches of one point, use reframe-jax calibrate (rf.calibrate), which estimates "
            "the tip and the residual of each touch. If rows are shuffled, sort them by time."
        )
    elif Caution.IMPROBABLE_ASSUMED in found:
        sentences.append(f"Other constraints fit better than the assumed one{stated}.")
    elif Caution.IMPROBABLE in found:
        uncertain = f"The name is uncertain{stated}."
        remedy = " Record a larger motion along every free direction."
        sentences.append(uncertain + ("" if Caution.FEW_VELOCITIES in found else remedy))
    if Caution.NOISY_SCALE in found:
        sentences.append(
            f"At a chosen time scale, the motion is less than {EVIDENCE.above_noise:g} times the noise, "
            "which can distort the frame. scales='auto' leaves out such scales."
        )
    close = [
        f"{group} axis {axis + 1} ({speeds[i][axis]:.3g} {unit})"
        for i, (group, unit) in enumerate((("angular", "rad/s"), ("linear", "m/s")))
        for axis in range(3)
        if found & (Caution.CLOSE_ANGULAR_1, Caution.CLOSE_LINEAR_1)[i] << axis
    ]
    if close:
        sentences.append(
            f"The velocities along these axes are close to the threshold: {', '.join(close)}. It is "
            "uncertain whether these axes are free. Choose a threshold between the slow and the fast axes."
        )
    return sentences
