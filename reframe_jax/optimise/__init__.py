"""Global minimisation of frame objectives, for many problems at once.

``BasinHopping`` is the outer loop; ``JointSearch`` puts it to work for norms of negative exponent. Inside
it goes a local minimiser: ``ValleySteps`` (origins, with the rotation eliminated), ``FrameSteps``
(orientation and origin together), ``NewtonSteps`` (any objective) or ``OptaxSteps`` (any objective, any
Optax gradient transformation).
"""

from reframe_jax.optimise.basin_hopping import (
    BasinHopping,
    LocalMinimiser,
    Objective,
    SearchState,
    Solution,
    Solver,
)
from reframe_jax.optimise.box import Box
from reframe_jax.optimise.frame import FrameSteps
from reframe_jax.optimise.gradient import OptaxSteps
from reframe_jax.optimise.joint import JointSearch
from reframe_jax.optimise.newton import NewtonSteps
from reframe_jax.optimise.valley import ValleySteps

__all__ = [
    "BasinHopping",
    "Box",
    "FrameSteps",
    "JointSearch",
    "LocalMinimiser",
    "NewtonSteps",
    "Objective",
    "OptaxSteps",
    "SearchState",
    "Solution",
    "Solver",
    "ValleySteps",
]
