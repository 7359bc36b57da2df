"""Former name of :mod:`reframe_jax.solvers`; kept until version 0.3."""

from reframe_jax.solvers import *  # noqa: F403
from reframe_jax.solvers import __all__ as __all__
