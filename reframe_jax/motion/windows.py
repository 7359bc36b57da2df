"""Divide a recording into sliding windows."""

import numpy as np


def sliding_windows(samples: np.ndarray, length: int, stride: int = 1) -> np.ndarray:
    """Divide a recording into overlapping windows of equal length, as a read-only view without a copy.

    Args:
        samples: (N, ...), for example poses (N, 4, 4) or times (N,).
        length: number of samples per window; a window of K steps has K + 1 poses.
        stride: number of samples between the starts of two consecutive windows.

    Returns:
        (W, length, ...) for W windows; samples after the last full window are left out.

    Raises:
        ValueError: if the recording is shorter than one window, or a size is not positive.
    """
    samples = np.asarray(samples)
    if length < 1 or stride < 1:
        raise ValueError(f"length and stride must be at least 1, not {length} and {stride}.")
    if len(samples) < length:
        raise ValueError(f"A window of {length} samples does not fit a recording of {len(samples)}.")
    view = np.lib.stride_tricks.sliding_window_view(samples, length, axis=0)
    return np.moveaxis(view, -1, 1)[::stride]
