"""Former name of :mod:`reframe_jax.simulation.arm`; kept until version 0.3."""

from reframe_jax.simulation.arm import *  # noqa: F403
from reframe_jax.simulation.arm import __all__ as __all__
