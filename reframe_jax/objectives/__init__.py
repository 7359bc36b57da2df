"""The norms that a constraint frame minimizes, from moments, and the objective protocol."""

from reframe_jax.objectives.norms import check_exponent, log_power_mean
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective

__all__ = [
    "FrameObjective",
    "MomentsObjective",
    "Objective",
    "PositionObjective",
    "check_exponent",
    "log_power_mean",
]
