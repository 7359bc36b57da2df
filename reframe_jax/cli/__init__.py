"""The command line ``reframe-jax``."""

from reframe_jax.cli.process import main

__all__ = ["main"]
