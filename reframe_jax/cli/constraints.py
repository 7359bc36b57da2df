"""``reframe-jax constraints``: list the catalogue of constraints."""

import argparse
from typing import Any

from reframe_jax.cli.commands import add_command
from reframe_jax.cli.printing import print_result
from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS


def add_constraints(commands: Any) -> None:
    """Add the command ``constraints`` to the parser."""
    add_command(commands, "constraints", _constraints, "List the named constraints.", compiles=False)


def _constraints(options: argparse.Namespace) -> int:
    """Print the catalogue: degrees of freedom along x, y, z, and the determined axes and components."""
    layout = "{:13} {:26} {:9} {:12} {:6} {}"
    print_result(layout.format("", "name", "rotation", "translation", "frame", "position"))
    for entry in (CONSTRAINTS | OTHER_CONSTRAINTS).values():
        free = ["".join(map(str, dof)) for dof in (entry.angular_dof, entry.linear_dof)]
        unique = "".join(axis for axis, is_unique in zip("xyz", entry.position, strict=True) if is_unique)
        frame = "any" if entry.linear_type is None else str(entry.linear_type)
        print_result(layout.format(entry.label, entry.name, *free, frame, unique or "-"))
    print_result("\n1 is free, 0 constrained, along x, y, z of the frame; position: determined components.")
    return 0
