"""Calibrate a tool: find its tip or its axis.

The tip follows from poses in which the tip rests on one point (pivot
calibration), the axis from rotations of the tool about this axis (--spin).

A file contains at least four poses of the tool, one per row, in any order; times
are not needed. Outliers are listed and left out.
"""

import argparse
from pathlib import Path
from typing import Any

from reframe_jax.calibration.tool import calibrate
from reframe_jax.cli.outputs import add_outputs, check_outputs, write_document
from reframe_jax.cli.printing import fail, print_error, print_result
from reframe_jax.cli.reading import add_reading, read_recording
from reframe_jax.export.calibration import SCHEMA, calibration_to_record, calibration_to_table
from reframe_jax.recordings.recording import RecordingError, is_path

_CONTINUOUS = (
    "consecutive poses are close together, so that their errors are correlated and the intervals below are "
    "too small: use one pose for each touch, or compare the result with reframe-jax identify --assume"
)


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the files and the options of calibration."""
    command.add_argument("--spin", action="store_true", help="find the axis about which a tool was turned")
    add_outputs(command, plot=False)
    add_reading(command)


def run(options: argparse.Namespace) -> int:
    """Calibrate the tool of every recording."""
    check_outputs(options)
    return write_document([_calibrate_file(path, options) for path in options.files], SCHEMA, options)


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
