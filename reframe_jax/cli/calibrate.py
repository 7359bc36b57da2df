"""``reframe-jax calibrate``: the tip or the axis of a tool."""

import argparse
import json
from pathlib import Path
from typing import Any

from reframe_jax.calibration.tool import calibrate
from reframe_jax.cli.commands import add_command
from reframe_jax.cli.outputs import check_file, write_document
from reframe_jax.cli.printing import print_error, print_result
from reframe_jax.cli.reading import add_reading, expand, read_recording
from reframe_jax.export.calibration import SCHEMA, calibration_to_record, calibration_to_table
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import is_path

__all__ = ["add_calibrate"]

_CALIBRATE = """\
Calibrate a tool: find its tip from poses in which the tip rests on one point
(pivot calibration), or its axis from rotations of the tool about this axis
(--spin).

A file contains at least four poses of the tool, one per row, in any order; times
are not needed. Outliers are listed and left out.
"""
_CONTINUOUS = (
    "the poses are a continuous motion, in which errors of neighbours are alike: the intervals below are too "
    "small; compare them with"
)


def add_calibrate(commands: Any) -> None:
    """Add this command to the command line."""
    command = add_command(commands, "calibrate", _calibrate, _CALIBRATE, compiles=False)
    add = command.add_argument
    add("files", nargs="+", type=Path, metavar="FILE", help="recordings")
    add("--spin", action="store_true", help="find the axis of a tool that was turned about its own axis")
    add("--json", metavar="OUT", help="write the results as JSON; - prints them instead of tables")
    add_reading(command)


def _calibrate(options: argparse.Namespace) -> int:
    options.files = expand(options.files)
    if options.json not in (None, "-"):
        check_file("--json", Path(options.json), options)
    records = [_calibrate_file(path, options) for path in options.files]
    failed = any(record["error"] is not None for record in records)
    document = {"schema": SCHEMA, "recordings": records}
    problem = write_document(lambda: json.dumps(document, indent=2, allow_nan=False), options)
    if problem is not None:
        print_error(f"reframe-jax: error: {problem}")
    return int(failed or problem is not None)


def _calibrate_file(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Calibrate and print one recording; return its entry in the JSON document."""
    notes: tuple[str, ...] = ()
    record: dict[str, Any] | None = None
    problem: str | None = None
    try:
        recording = read_recording(path, options, timed=False)
        notes = recording.notes
        found = calibrate(recording.poses, spin=options.spin)
    except RecordingError as error:
        problem = str(error)
    except ValueError as error:
        problem = f"{path}: {error}"
    else:
        if is_path(recording.poses[:, :3, 3]):
            known = "hinge" if options.spin else "ball"
            notes = (*notes, f"{_CONTINUOUS} reframe-jax identify --assume {known}.")
            print_error(f"reframe-jax: {path}: {notes[-1]}")
        if options.json != "-":
            print_result(calibration_to_table(found, recording), end="\n\n")
        record = calibration_to_record(found, recording)
    if problem is not None:
        print_error(f"reframe-jax: error: {problem}")
    return {"recording": str(path), "error": problem, "notes": list(notes), "calibration": record}
