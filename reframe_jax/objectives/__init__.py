"""Objectives: the functions that solvers minimize.

The objectives of the library are the paper's norms of the velocity of a frame, computed from second moments.
A user may minimize any function that has the members of ``Objective``.
"""

from reframe_jax.objectives.norms import log_power_mean
from reframe_jax.objectives.protocol import MomentsObjective, Objective
from reframe_jax.objectives.velocity import FrameObjective, PositionObjective

__all__ = ["FrameObjective", "MomentsObjective", "Objective", "PositionObjective", "log_power_mean"]
