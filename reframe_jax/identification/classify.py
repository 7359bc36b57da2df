"""The paper's classification: thresholds of RMS velocities."""

from dataclasses import dataclass

import jax


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Thresholds:
    """The paper's rule for free axes: an axis is free if its RMS velocity exceeds a threshold.

    The defaults are the midpoints of the ranges that classify the paper's robot data correctly (section 5.6).

    Attributes:
        angular: threshold of rotations, rad/s.
        linear: threshold of translations, m/s.
    """

    angular: float | jax.Array = 0.160
    linear: float | jax.Array = 0.037
