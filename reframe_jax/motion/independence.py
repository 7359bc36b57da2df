"""How soon a motion says something new."""

import numpy as np

__all__ = ["independent_after"]


def independent_after(velocities: np.ndarray) -> float:
    """Samples after which a motion is independent of what it was before.

    This is the integral of its squared correlation (Bartlett), up to where that first vanishes.

    Args:
        velocities: (K, n); each component in a unit that makes it count as much as the others.
    """
    size = 1 << (2 * len(velocities) - 1).bit_length()
    spectrum = np.fft.rfft(velocities, size, axis=0)
    correlation = np.fft.irfft(np.sum(np.abs(spectrum) ** 2, axis=1), size)[: len(velocities)]
    if correlation[0] <= 0:
        return 1.0
    correlation = correlation / correlation[0]
    negative = np.flatnonzero(correlation <= 0)
    end = negative[0] if len(negative) else len(correlation)
    return float(1 + 2 * np.sum(correlation[1:end] ** 2))
