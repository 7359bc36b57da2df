"""``reframe-jax calibrate``: find the tip or the axis of a tool."""

import argparse
import json
from pathlib import Path
from typing import Any

from reframe_jax.calibration.tool import calibrate
from reframe_jax.cli.commands import add_command
from reframe_jax.cli.outputs import add_outputs, check_outputs, write_document
from reframe_jax.cli.printing import fail, print_error, print_result
from reframe_jax.cli.reading import add_reading, expand, read_recording
from reframe_jax.export.calibration import SCHEMA, calibration_to_record, calibration_to_table
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import is_path

_CALIBRATE = """\
Calibrate a tool: find its tip from poses in which the tip rests on one point
(pivot calibration), or its axis from rotations of the tool about this axis
(--spin).

A file contains at least four poses of the tool, one per row, in any order; times
are not needed. Outliers are listed and left out.
"""
_CONTINUOUS = (
    "consecutive poses are close together, so that their errors are correlated and the intervals below are "
    "too small: use one pose for each touch, or compare the result with reframe-jax identify --assume"
)


def add_calibrate(commands: Any) -> None:
    """Add the command ``calibrate`` to the parser."""
    command = add_command(commands, "calibrate", _calibrate, _CALIBRATE, compiles=False)
    command.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings")
    command.add_argument("--spin", action="store_true", help="find the axis about which a tool was turned")
    add_outputs(command, plot=False)
    add_reading(command)


def _calibrate(options: argparse.Namespace) -> int:
    options.files = expand(options.files)
    check_outputs(options)
    records = [_calibrate_file(path, options) for path in options.files]
    document = {"schema": SCHEMA, "recordings": records}
    written = write_document(lambda: json.dumps(document, indent=2, allow_nan=False), options)
    return int(not written or any(record["error"] is not None for record in records))


def _calibrate_file(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Calibrate and print one recording; return its entry in the JSON document."""
    entry: dict[str, Any] = {"recording": str(path), "error": None, "notes": [], "calibration": None}
    try:
        recording = read_recording(path, options, timed=False)
        entry["notes"] += recording.notes
        found = calibrate(recording.poses, spin=options.spin)
    except ValueError as error:
        entry["error"] = str(error) if isinstance(error, RecordingError) else f"{path}: {error}"
        fail(entry["error"])
        return entry
    if is_path(recording.poses[:, :3, 3]):
        entry["notes"].append(f"{_CONTINUOUS} {'hinge' if options.spin else 'ball'}.")
        print_error(f"reframe-jax: {path}: {entry['notes'][-1]}")
    if options.json != "-":
        print_result(calibration_to_table(found, recording), end="\n\n")
    entry["calibration"] = calibration_to_record(found, recording)
    return entry
