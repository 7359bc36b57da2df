"""Tasks reproduced with control in constraint frames (paper, section 6).

The arm starts at one end-stop of a constraint and is to reach the other, moved by wrenches along the
axes of a control frame: the true one, one with errors, or one that was identified. What an inexact
frame costs is the reaction along the true constrained axes; an exact one has some too, from the arm's
own inertia and friction, and is the baseline beside every figure.
"""

from reframe_jax.simulation.reproduction.comparison import Comparison, compare, matched_choices
from reframe_jax.simulation.reproduction.controllers import (
    Controller,
    axis_impedance,
    constant_wrench,
    hybrid,
)
from reframe_jax.simulation.reproduction.frames import (
    LITERATURE_ERRORS,
    ROOMY,
    control_frames,
    erroneous_frames,
)
from reframe_jax.simulation.reproduction.trials import Task, Trials, reproduce

__all__ = [
    "LITERATURE_ERRORS",
    "ROOMY",
    "Comparison",
    "Controller",
    "Task",
    "Trials",
    "axis_impedance",
    "compare",
    "constant_wrench",
    "control_frames",
    "erroneous_frames",
    "hybrid",
    "matched_choices",
    "reproduce",
]
