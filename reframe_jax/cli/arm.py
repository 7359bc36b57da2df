"""Options that ``demonstrate`` and ``reproduce`` have in common. MuJoCo is imported when a command runs."""

import argparse
from typing import Any

from reframe_jax.cli import arguments
from reframe_jax.cli.configuring import add_cache, configure_jax
from reframe_jax.storage.progress import make_meter

_IMPERFECTIONS = {"none": None, "encoder": "ENCODER_GRADE", "realistic": "REALISTIC", "matched": "MATCHED"}


def add_common(command: argparse.ArgumentParser) -> None:
    """Add the options that ``demonstrate`` and ``reproduce`` have in common to a command."""
    add = command.add_argument
    arguments.add_constraint(command)
    add("--robot", choices=["panda", "fr3"], default="panda", help="robot arm; the paper uses fr3 (panda)")
    add(
        "--imperfections",
        choices=[*_IMPERFECTIONS],
        default="realistic" if command.prog.endswith("reproduce") else "encoder",
        help="errors of the poses: none, encoder noise, encoder noise and compliance, or the compliance of "
        "the paper's set-up (%(default)s)",
    )
    add(
        "--excitation",
        choices=["exciting", "brisk"],
        default="exciting",
        help="motion along the free axes: many frequencies; brisk turns hinges as fast as in the paper's "
        "Table 4 (exciting)",
    )
    add("--fixed", action="store_true", help="use one geometry for all demonstrations instead of random ones")
    arguments.add_seed(command)
    add_cache(command)


def prepare(options: argparse.Namespace) -> dict[str, Any]:
    """Configure JAX, and return the options of :func:`add_common` as arguments of a simulation."""
    configure_jax(options.cache)
    from reframe_jax.simulation import arm

    name = _IMPERFECTIONS[options.imperfections]
    return {
        "imperfections": arm.Imperfections() if name is None else getattr(arm, name),
        "excitation": options.excitation,
        "spread": (0.0, 0.0) if options.fixed else arm.SPREAD,
        "arm": options.robot,
        "progress": make_meter(None, "demonstrations"),
    }
