"""Reasons to doubt a result that has a good status: codes in a batch, sentences for one window."""

from enum import IntFlag

import jax
import jax.numpy as jnp

from reframe_jax.identification.classify import Thresholds

__all__ = ["Caution", "caution_codes", "caution_sentences"]

_FEW = 12  # velocities up to which many windows are identified wrongly
_CLOSE = 1.5  # factor from a threshold within which an axis is neither clearly free nor constrained


class Caution(IntFlag):
    """Reasons to doubt a result, as bits of ``Identification.warning_codes``."""

    FEW_VELOCITIES = 1
    """So few velocities that many motions fit."""
    CLOSE_ANGULAR_1 = 16
    """The velocity along this axis of the angular frame is close to the threshold."""
    CLOSE_ANGULAR_2 = 32
    CLOSE_ANGULAR_3 = 64
    CLOSE_LINEAR_1 = 128
    """The same of the linear frame."""
    CLOSE_LINEAR_2 = 256
    CLOSE_LINEAR_3 = 512
    IMPROBABLE = 1024
    """Other names are together more probable than the one reported."""
    IMPROBABLE_ASSUMED = 4096
    """The same of a constraint that the caller assumes."""
    UNORDERED = 2048
    """The poses do not follow each other as those of a motion do."""


def caution_codes(
    velocities: jax.Array,
    rms: tuple[jax.Array, jax.Array],
    thresholds: Thresholds | None,
    marks: dict[Caution, jax.Array],
) -> jax.Array:
    """The code of a window, () int32.

    Args:
        velocities: () number of steps between poses that count.
        rms: (3,) rad/s and (3,) m/s, along the axes of both frames.
        thresholds: above which an axis is free, or None.
        marks: () bool, other reasons.
    """
    marked = {Caution.FEW_VELOCITIES: velocities <= _FEW, **marks}
    if thresholds is not None:
        levels = thresholds.angular, thresholds.linear
        first = Caution.CLOSE_ANGULAR_1, Caution.CLOSE_LINEAR_1
        for code, speeds, level in zip(first, rms, levels, strict=True):
            close = (speeds > level / _CLOSE) & (speeds < level * _CLOSE)
            marked |= {Caution(code << axis): close[axis] for axis in range(3)}
    codes = jnp.zeros((), jnp.int32)
    for caution, true in marked.items():
        codes = codes | jnp.where(true, jnp.int32(caution), 0)
    return codes


def caution_sentences(
    code: int, velocities: int, speeds: tuple[list[float], list[float]], probability: float
) -> list[str]:
    """The sentences of one window.

    Args:
        code: bits of :class:`Caution`.
        velocities: number of steps between poses that count.
        speeds: rad/s and m/s, RMS along the axes of both frames.
        probability: of the name.
    """
    found = Caution(code)
    stated = f"probability {'below 0.01' if probability < 0.01 else f'{probability:.2f}'}"
    sentences = []
    if Caution.FEW_VELOCITIES in found:
        sentences.append(
            f"Only {velocities + 1} poses count ({velocities} steps): with {_FEW} steps or fewer, many "
            "windows are identified wrongly. Take longer windows; for separate touches of one point, use "
            "reframe-jax calibrate (rf.calibrate)."
        )
    if Caution.UNORDERED in found:
        sentences.append(
            "The poses do not follow each other as in a motion: consecutive poses are as far apart as any "
            "two poses. With scales='auto', displacements about the mean are used, which need no order. For "
            "separate touches of one point, reframe-jax calibrate (rf.calibrate) finds the tip and the "
            "residual of each; if rows are shuffled, sort them by time."
        )
    elif Caution.IMPROBABLE_ASSUMED in found:
        sentences.append(f"Other constraints fit better than the assumed one ({stated}).")
    elif Caution.IMPROBABLE in found:
        uncertain = f"The name is uncertain ({stated})."
        remedy = " Record a motion that goes farther along every free direction."
        sentences.append(uncertain + ("" if Caution.FEW_VELOCITIES in found else remedy))
    close = [
        f"{group} axis {axis + 1} ({speeds[i][axis]:.3g} {unit})"
        for i, (group, unit) in enumerate((("angular", "rad/s"), ("linear", "m/s")))
        for axis in range(3)
        if found & (Caution.CLOSE_ANGULAR_1, Caution.CLOSE_LINEAR_1)[i] << axis
    ]
    if close:
        sentences.append(
            f"The velocities along these axes are close to the threshold: {', '.join(close)}. Whether these "
            "axes are free is uncertain. Choose a threshold between the slow and the fast axes."
        )
    return sentences
