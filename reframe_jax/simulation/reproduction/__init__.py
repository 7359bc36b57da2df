"""Tasks reproduced with control in constraint frames (paper, section 6).

The arm starts at one end-stop of a constraint and moves to the other under wrenches along the axes of a
control frame: the true frame, one with errors, or an identified one. An inexact frame causes reactions along
the true constrained axes. The exact frame causes some too, from the inertia and friction of the arm, and is
the baseline.
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
from reframe_jax.simulation.reproduction.sequences import SequenceTrial, reproduce_sequence
from reframe_jax.simulation.reproduction.trials import Task, Trials, reproduce

__all__ = [
    "LITERATURE_ERRORS",
    "ROOMY",
    "Comparison",
    "Controller",
    "SequenceTrial",
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
    "reproduce_sequence",
]
