"""Former name of :mod:`reframe_jax.simulation.reproduction`; kept until version 0.3."""

from reframe_jax.simulation.reproduction import *  # noqa: F403
from reframe_jax.simulation.reproduction import __all__ as __all__
