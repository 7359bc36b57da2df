"""The command line ``reframe-jax``."""

from reframe_jax.cli.program import main

__all__ = ["main"]
