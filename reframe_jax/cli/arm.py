"""Options shared by the commands that simulate the arm. MuJoCo is imported when they run."""

import argparse
import sys
from typing import Any

from reframe_jax.cli import arguments
from reframe_jax.cli.configuring import configure_jax
from reframe_jax.cli.printing import print_error

__all__ = ["add_common", "prepare"]


def add_common(command: argparse.ArgumentParser) -> None:
    """Add the options of both commands."""
    add = command.add_argument
    arguments.add_constraint(command)
    add("--robot", choices=["panda", "fr3"], default="panda", help="the arm; fr3 is the paper's (panda)")
    add(
        "--imperfections",
        choices=["none", "encoder", "realistic", "matched"],
        default="realistic" if command.prog.endswith("reproduce") else "encoder",
        help="none; noise of the encoders; that and compliance; or the compliance of the paper's "
        "set-up (%(default)s)",
    )
    add(
        "--excitation",
        choices=["exciting", "brisk", "paper"],
        default="exciting",
        help="how the hand moves along the free axes: with many frequencies; likewise, hinges as fast as "
        "in the paper's Table 4; or as in the paper's simulations (exciting)",
    )
    add("--fixed", action="store_true", help="use the same geometry every time instead of a random one")
    arguments.add_seed(command)


def prepare(options: argparse.Namespace) -> dict[str, Any]:
    """Configure JAX, and return the options that both commands pass on."""
    configure_jax(options.cache)
    from reframe_jax.simulation import arm as panda

    kinds = {
        "none": panda.Imperfections(),
        "encoder": panda.ENCODER_GRADE,
        "realistic": panda.REALISTIC,
        "matched": panda.MATCHED,
    }
    return {
        "imperfections": kinds[options.imperfections],
        "excitation": options.excitation,
        "spread": (0.0, 0.0) if options.fixed else panda.SPREAD,
        "arm": options.robot,
        "progress": _progress if sys.stderr.isatty() else None,
    }


def _progress(done: int, count: int) -> None:
    print_error(f"\r{done} of {count} demonstrations", end="\n" if done == count else "")
