"""Reproduce tasks with a controller in a constraint frame (paper, section 6).

The arm moves along the free axes of a constraint, from one end-stop (mechanical limit of travel) to the
other. Wrenches act along the axes of a control frame, which is the true frame, a frame with errors, or an
identified frame. An inexact frame causes reaction forces along the true constrained axes. The exact frame is
the baseline: its reaction forces come from the inertia and friction of the arm only.
"""

from reframe_jax.simulation.reproduction.comparison import Comparison, compare, matched_choices
from reframe_jax.simulation.reproduction.controllers import (
    Controller,
    axis_impedance,
    constant_wrench,
    hybrid,
)
from reframe_jax.simulation.reproduction.trials import (
    ROOMY,
    SequenceTrial,
    Trials,
    control_frames,
    reproduce,
    reproduce_sequence,
)

__all__ = [
    "ROOMY",
    "Comparison",
    "Controller",
    "SequenceTrial",
    "Trials",
    "axis_impedance",
    "compare",
    "constant_wrench",
    "control_frames",
    "hybrid",
    "matched_choices",
    "reproduce",
    "reproduce_sequence",
]
