"""Simulate demonstrations: a hand guides a Franka arm under a constraint, in large batches with MJX.

from reframe_jax.simulation import arm

made = arm.demonstrate("K", jax.random.key(0), batch=64)
found = rf.identify(made.poses, times=made.times)
"""

try:
    import mujoco  # noqa: F401
except (ImportError, AttributeError, RuntimeError, OSError) as error:
    import os

    if "MUJOCO_GL" not in os.environ:
        raise
    raise ImportError(
        f"MuJoCo cannot be loaded with MUJOCO_GL={os.environ['MUJOCO_GL']} ({error}). "
        "Install the libraries of this backend, set MUJOCO_GL to egl, osmesa or glfw, or unset it."
    ) from error

from reframe_jax.simulation.arm.collection import demonstrations, store_demonstrations, stored_demonstrations
from reframe_jax.simulation.arm.demonstration import (
    SPREAD,
    Demonstration,
    SequenceDemonstration,
    demonstrate,
    demonstrate_sequence,
    frame_on_arm,
)
from reframe_jax.simulation.arm.guide import EXCITATIONS
from reframe_jax.simulation.arm.imperfections import ENCODER_GRADE, MATCHED, REALISTIC, Imperfections
from reframe_jax.simulation.arm.model import FR3, PANDA, ROBOTS, Arm, Motion, arm_motion, forward_kinematics
from reframe_jax.simulation.arm.rollout import RolloutStatus

__all__ = [
    "ENCODER_GRADE",
    "EXCITATIONS",
    "FR3",
    "MATCHED",
    "PANDA",
    "REALISTIC",
    "ROBOTS",
    "SPREAD",
    "Arm",
    "Demonstration",
    "Imperfections",
    "Motion",
    "RolloutStatus",
    "SequenceDemonstration",
    "arm_motion",
    "demonstrate",
    "demonstrate_sequence",
    "demonstrations",
    "forward_kinematics",
    "frame_on_arm",
    "store_demonstrations",
    "stored_demonstrations",
]
