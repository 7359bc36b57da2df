"""``reframe-jax constraints``: the catalogue."""

import argparse
from typing import Any

from reframe_jax.cli.commands import COMMANDS
from reframe_jax.cli.printing import print_result
from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS

__all__ = ["add_constraints"]


def add_constraints(commands: Any) -> None:
    """Add the command to those of the command line."""
    commands.add_parser("constraints", help=COMMANDS["constraints"]).set_defaults(run=_constraints)


def _constraints(options: argparse.Namespace) -> int:
    """The catalogue: degrees of freedom along x, y, z of the frame, and what is unique."""
    layout = "{:13} {:26} {:9} {:12} {:6} {}"
    print_result(layout.format("", "name", "rotation", "translation", "frame", "position"))
    for entry in (CONSTRAINTS | OTHER_CONSTRAINTS).values():
        free = ["".join(map(str, dof)) for dof in (entry.angular_dof, entry.linear_dof)]
        unique = "".join(axis for axis, is_unique in zip("xyz", entry.position, strict=True) if is_unique)
        frame = "any" if entry.linear_type is None else str(entry.linear_type)
        print_result(layout.format(entry.label, entry.name, *free, frame, unique or "-"))
    print_result("\n1 is free, 0 constrained, along x, y, z of the frame; position: its unique components.")
    return 0
