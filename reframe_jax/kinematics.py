"""Former name of :mod:`reframe_jax.motion.kinematics`; kept until version 0.3."""

from reframe_jax.motion.kinematics import *  # noqa: F403
from reframe_jax.motion.kinematics import __all__ as __all__
