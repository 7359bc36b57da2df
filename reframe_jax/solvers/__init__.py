"""Global minimisation of frame objectives, for many problems at once.

``BasinHopping`` is the outer loop; ``JointSearch`` puts it to work for norms of negative exponent. Inside
it goes a local minimiser: ``ValleySteps`` (origins, with the rotation eliminated), ``FrameSteps``
(orientation and origin together), ``NewtonSteps`` (any objective) or ``OptaxSteps`` (any objective, any
Optax gradient transformation).
"""

from reframe_jax.solvers.basin_hopping import (
    BasinHopping,
    LocalMinimiser,
    Objective,
    SearchState,
    Solution,
    Solver,
)
from reframe_jax.solvers.box import Box
from reframe_jax.solvers.frame_steps import FrameSteps
from reframe_jax.solvers.joint_search import JointSearch
from reframe_jax.solvers.newton_steps import NewtonSteps
from reframe_jax.solvers.optax_steps import OptaxSteps
from reframe_jax.solvers.valley_steps import ValleySteps

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
