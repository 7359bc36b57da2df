"""The norms that a constraint frame minimizes, from samples or moments, and the objective protocol."""

from reframe_jax.objectives.norms import (
    axis_rms,
    check_exponent,
    frame_norm,
    log_power_mean,
    power_mean,
)
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective

__all__ = [
    "FrameObjective",
    "MomentsObjective",
    "Objective",
    "PositionObjective",
    "axis_rms",
    "check_exponent",
    "frame_norm",
    "log_power_mean",
    "power_mean",
]
