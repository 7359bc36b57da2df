"""JAX settings of the command line."""

import argparse
import os

import jax

from reframe_jax.compilation import COMPILER_OPTIONS
from reframe_jax.program_cache import cache_programs

_FAST_COMPILATION = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"


def add_cache(command: argparse.ArgumentParser) -> None:
    """Add the option ``--no-cache`` to a command that compiles programs."""
    command.add_argument(
        "--no-cache",
        dest="cache",
        action="store_false",
        help="do not store compiled programs for later runs (REFRAME_JAX_CACHE=0 has the same effect); "
        "to delete stored programs, delete the folder reframe_jax in XDG_CACHE_HOME or ~/.cache",
    )


def configure_jax(cache: bool) -> None:
    """Enable 64-bit mode, and keep compiled programs between runs, unless ``REFRAME_JAX_CACHE=0``."""
    flags = os.environ.get("XLA_FLAGS", "")
    if COMPILER_OPTIONS is None and "xla_backend_extra_options" not in flags:
        # the same option for all programs; the compiler reads it when it starts
        os.environ["XLA_FLAGS"] = f"{flags} {_FAST_COMPILATION}".strip()
    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]
    if cache and os.environ.get("REFRAME_JAX_CACHE") != "0":
        cache_programs()
