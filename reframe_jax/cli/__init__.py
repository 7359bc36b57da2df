"""The command line ``reframe-jax``."""

from reframe_jax.cli.program import run_process as main

__all__ = ["main"]
