"""Former name of :mod:`reframe_jax.geometry.transforms`; kept until version 0.3."""

from reframe_jax.geometry.transforms import *  # noqa: F403
from reframe_jax.geometry.transforms import __all__ as __all__
