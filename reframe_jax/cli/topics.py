"""List the data in files.

The data are topics and tf frames of bags, rigid bodies and markers of motion
capture, and columns of data sets. Each line starts with the option that selects
the entry.
"""

import argparse
from pathlib import Path

from reframe_jax.cli.printing import fail, print_result
from reframe_jax.recordings.reading import list_contents
from reframe_jax.recordings.recording import RecordingError, shown
from reframe_jax.recordings.selection import flag


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the files."""
    command.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings")


def run(options: argparse.Namespace) -> int:
    """Print the data in every file."""
    failed = 0
    for path in options.files:
        try:
            kind, entries = list_contents(path)
        except RecordingError as error:
            failed = fail(error)
            continue
        only = ": a single recording" if entries is None else "" if entries else ": nothing that can be read"
        print_result(f"{path}: {kind}{only}")
        rows = [
            (f"{flag(each.option).partition('(')[2].rstrip(')')} {shown(each.name)}", shown(each.detail))
            for each in entries or []
        ]
        width = max((len(choice) for choice, _ in rows), default=0)
        for choice, detail in rows:
            print_result(f"  {choice:{width}}  {detail}")
    return failed
