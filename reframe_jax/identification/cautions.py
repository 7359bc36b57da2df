"""Reasons to doubt a result that has a good status: codes in a batch, sentences for one window."""

from enum import IntFlag

import jax

from reframe_jax.arrays import jnp
from reframe_jax.identification.classify import Thresholds

__all__ = ["Caution", "caution_codes", "caution_sentences"]

_UNKNOWNS = 5  # of one constrained axis: its direction, and where the origin is
_FEW = 12  # velocities up to which many windows are identified wrongly
_CLOSE = 1.5  # factor from a threshold within which an axis is neither clearly free nor constrained


class Caution(IntFlag):
    """Reasons to doubt a result, as bits of ``Identification.warning_codes``."""

    FEW_VELOCITIES = 1
    """So few velocities that many motions fit."""
    FAR_ORIGIN = 2
    """The origin was found in a larger box than usual."""
    ROUNDED = 4
    """The poses are written with so few digits that their rounding is the noise."""
    COUPLED = 8
    """Other axes with other origins explain the motion as well."""
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


def caution_codes(
    poses: jax.Array,
    lag: jax.Array,
    rms: tuple[jax.Array, jax.Array],
    thresholds: Thresholds | None,
    cautions: dict[Caution, jax.Array],
) -> jax.Array:
    """The codes of windows, (N,) int32.

    Args:
        poses: (N,) number of poses that count.
        lag: (N,) samples between the poses of a velocity.
        rms: (N, 3) rad/s and (N, 3) m/s, along the axes of both frames.
        thresholds: above which an axis is free, or None.
        cautions: (N,) bool, what else there is to say.
    """
    few = (poses - 1 <= _FEW) | ((poses - 1) // jnp.maximum(lag, 1) <= _UNKNOWNS)
    marked = {Caution.FEW_VELOCITIES: few, **cautions}
    if thresholds is not None:
        levels = thresholds.angular, thresholds.linear
        first = Caution.CLOSE_ANGULAR_1, Caution.CLOSE_LINEAR_1
        for code, speeds, level in zip(first, rms, levels, strict=True):
            close = (speeds > level / _CLOSE) & (speeds < level * _CLOSE)
            marked |= {Caution(code << axis): close[:, axis] for axis in range(3)}
    codes = jnp.zeros(poses.shape, jnp.int32)
    for caution, true in marked.items():
        codes = codes | jnp.where(true, jnp.int32(caution), 0)
    return codes


def caution_sentences(
    code: int, velocities: int, lag: int, speeds: tuple[list[float], list[float]], probability: float
) -> list[str]:
    """What the code of one window says.

    Args:
        code: bits of :class:`Caution`.
        velocities: number of steps between poses that count.
        lag: samples between the poses of a velocity.
        speeds: rad/s and m/s, RMS along the axes of both frames.
        probability: of the name.
    """
    found = Caution(code)
    sentences = []
    if Caution.FEW_VELOCITIES in found:
        sentences.append(_few(velocities, max(lag, 1)))
    if Caution.IMPROBABLE in found:
        sentences.append(
            f"The name has a probability of only {probability:.2f}: all others together have more. Move "
            "farther along every free direction."
        )
    close = [
        f"{group} axis {axis + 1} ({speeds[i][axis]:.3g} {unit})"
        for i, (group, unit) in enumerate((("angular", "rad/s"), ("linear", "m/s")))
        for axis in range(3)
        if found & (Caution.CLOSE_ANGULAR_1, Caution.CLOSE_LINEAR_1)[i] << axis
    ]
    if close:
        sentences.append(
            f"close to the threshold, so that free or constrained is uncertain: {', '.join(close)}. Look at "
            "the gaps between the velocities, and set the thresholds into them."
        )
    return sentences + [text for caution, text in _SENTENCES.items() if caution in found]


def _few(velocities: int, lag: int) -> str:
    independent = velocities // lag
    if independent > _UNKNOWNS:
        return (
            f"{velocities} velocities say little: with {_FEW} or fewer, many windows are identified wrongly. "
            "Take longer windows."
        )
    apart, remedy = ("", "") if lag == 1 else (" that do not overlap", ", or a shorter lag")
    subject = "1 velocity says" if independent == 1 else f"{independent} velocities{apart} say"
    return (
        f"{subject} nothing: with {_UNKNOWNS} or fewer, nearly every motion has a frame in which an axis "
        f"stands still. Take longer windows{remedy}."
    )


_SENTENCES = {
    Caution.FAR_ORIGIN: (
        "The motion points to an origin more than 1 m away: the search was widened. Errors of orientation "
        "act through this lever. Give `bounds` to search elsewhere."
    ),
    Caution.ROUNDED: (
        "The positions are rounded, and their rounding is the noise: a coordinate that hardly changes looks "
        "constrained. Record more digits."
    ),
    Caution.COUPLED: (
        "Other axes with other origins explain the motion as well: neither can be told without the other. "
        "Move in more ways."
    ),
}
