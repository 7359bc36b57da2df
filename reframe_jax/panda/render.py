"""Former name of :mod:`reframe_jax.simulation.arm.render`; kept until version 0.3."""

from reframe_jax.simulation.arm.render import *  # noqa: F403
from reframe_jax.simulation.arm.render import __all__ as __all__
