"""``reframe-jax topics``: list the data in files."""

import argparse
from pathlib import Path
from typing import Any

from reframe_jax.cli.commands import add_command
from reframe_jax.cli.printing import fail, print_result
from reframe_jax.recordings.reading import list_contents
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import shown
from reframe_jax.recordings.selection import flag

_TOPICS = """\
List the data in files: topics and tf frames of bags, rigid bodies and markers
of motion capture, columns of data sets. Each line starts with the option that
selects the entry.
"""


def add_topics(commands: Any) -> None:
    """Add the command ``topics`` to the parser."""
    command = add_command(commands, "topics", _topics, _TOPICS, compiles=False)
    command.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings")


def _topics(options: argparse.Namespace) -> int:
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
