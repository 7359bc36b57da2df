"""Former name of :mod:`reframe_jax.geometry.rotations`; kept until version 0.3."""

from reframe_jax.geometry.rotations import *  # noqa: F403
from reframe_jax.geometry.rotations import __all__ as __all__
