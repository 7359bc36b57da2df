"""Former name of :mod:`reframe_jax.simulation.synthetic`; kept until version 0.3."""

from reframe_jax.simulation.synthetic import *  # noqa: F403
from reframe_jax.simulation.synthetic import __all__ as __all__
