"""Solvers: find the global minimum of an objective, for many problems at once.

``BasinHopping`` is the global search: call ``minimise``, or run single steps with ``init``, ``step`` and
``finish``. ``JointSearch`` is a variant for norms with a negative exponent. The global search calls a local
minimizer, which the user chooses: ``ValleySteps`` (origins of frames), ``FrameSteps`` (orientations and
origins together), ``NewtonSteps`` (any ``Objective``) or ``OptaxSteps`` (any ``Objective``, with any Optax
gradient transformation).
"""

from reframe_jax.objectives.protocol import Objective
from reframe_jax.solvers.basin_hopping import BasinHopping, JointSearch, SearchState
from reframe_jax.solvers.moments_steps import FrameSteps, ValleySteps
from reframe_jax.solvers.newton_steps import NewtonSteps
from reframe_jax.solvers.optax_steps import OptaxSteps
from reframe_jax.solvers.protocol import Box, LocalMinimiser, Solution, Solver

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
