"""The options that divide a recording into windows."""

import argparse

from reframe_jax.cli import arguments
from reframe_jax.motion.checks import MIN_VELOCITIES

__all__ = ["add_windows", "check_windows"]


def add_windows(command: argparse.ArgumentParser) -> None:
    """Add the options ``--window`` and ``--stride`` to a command."""
    add = command.add_argument
    add("--window", type=arguments.whole, metavar="N", help="poses per window (all)")
    add("--stride", type=arguments.whole, metavar="M", help="poses between the starts of two windows (N)")


def check_windows(options: argparse.Namespace) -> None:
    """Report options that cannot be combined, and set the default stride."""
    if options.window is None:
        if options.stride is not None:
            options.usage_error("--stride needs --window.")
        options.stride = 1
    elif options.window < MIN_VELOCITIES + 1:
        options.usage_error(f"--window must be at least {MIN_VELOCITIES + 1} poses.")
    options.stride = options.window if options.stride is None else options.stride
    if options.stride < 1:
        options.usage_error("--stride must be at least 1.")
