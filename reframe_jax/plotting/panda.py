"""Former name of :mod:`reframe_jax.plotting.arm`; kept until version 0.3."""

from reframe_jax.plotting.arm import *  # noqa: F403
from reframe_jax.plotting.arm import __all__ as __all__
