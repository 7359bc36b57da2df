"""Former name of :mod:`reframe_jax.simulation.metrics`; kept until version 0.3."""

from reframe_jax.simulation.metrics import *  # noqa: F403
from reframe_jax.simulation.metrics import __all__ as __all__
