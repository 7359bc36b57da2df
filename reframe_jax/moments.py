"""Former name of :mod:`reframe_jax.objectives.moments`; kept until version 0.3."""

from reframe_jax.objectives.moments import *  # noqa: F403
from reframe_jax.objectives.moments import __all__ as __all__
