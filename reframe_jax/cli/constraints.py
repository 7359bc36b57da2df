"""List the named constraints."""

import argparse

from reframe_jax.cli.printing import print_result
from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS


def add_options(command: argparse.ArgumentParser) -> None:
    """Add no options."""


def run(options: argparse.Namespace) -> int:
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
