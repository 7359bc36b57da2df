"""Options of all commands that select files, and the data to read from each file."""

import argparse
import glob
from pathlib import Path
from typing import Any

from reframe_jax.cli import arguments
from reframe_jax.cli.printing import print_error
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording
from reframe_jax.recordings.selection import ANGLE_UNITS, ANGLES, QUATERNIONS, TIME_UNITS, UNITS

__all__ = ["add_reading", "expand", "read_recording", "reading_options"]

_NAMES = (
    *("unit", "time_unit", "dt", "topic", "from_frame", "to_frame", "body", "in_body"),
    *("position", "orientation", "quaternion", "angles", "angle_unit", "episode"),
)


def add_reading(command: argparse.ArgumentParser) -> None:
    """Add the options of :func:`reframe_jax.load_recording` to a command."""
    add = command.add_argument_group("data to read (reframe-jax topics FILE lists the choices)").add_argument
    add("--dt", type=arguments.seconds, metavar="S", help="sample time in s, for files without times")
    add("--unit", choices=[*UNITS], help="unit of positions, for files that do not state it (m)")
    add("--time-unit", choices=[*TIME_UNITS], help="unit of times, for files that do not state it (s)")
    add("--topic", metavar="NAME", help="topic of a bag")
    add("--from", dest="from_frame", metavar="FRAME", help="tf frame of a bag that serves as the ground")
    add("--to", dest="to_frame", metavar="FRAME", help="tf frame of a bag whose motion is read")
    add("--body", metavar="NAME", help="rigid body; in a C3D, a prefix of markers, or markers A,B,C")
    add("--in", dest="in_body", metavar="NAME", help="body (in a bag: topic) to which the motion is relative")
    add("--position", metavar="COLUMN", help="column of positions, such as NAME or NAME[0:3]")
    add("--orientation", metavar="COLUMN", help="column of orientations, such as NAME[3:7]")
    add("--quaternion", choices=QUATERNIONS, help="order of the components of quaternions in the file")
    add(
        "--angles",
        choices=ANGLES,
        metavar="HOW",
        help="convention of three angles: vector (rotation vector), XYZ etc. (rotations about moving axes, x "
        "first), xyz etc. (rotations about fixed axes)",
    )
    add("--angle-unit", choices=[*ANGLE_UNITS], help="unit of the three angles (rad)")
    add(
        "--episode",
        type=arguments.whole,
        metavar="N",
        help="number of the episode in a file with several episodes",
    )


def reading_options(options: argparse.Namespace) -> dict[str, Any]:
    """Keyword arguments of :func:`reframe_jax.load_recording`."""
    return {name: getattr(options, name) for name in _NAMES}


def expand(patterns: list[Path]) -> list[Path]:
    """Sorted files that match patterns; a pattern that matches nothing, or is a file, stands for itself."""
    return [path for pattern in patterns for path in _matches(pattern)]


def _matches(pattern: Path) -> list[Path]:
    if not glob.has_magic(str(pattern)) or pattern.exists():
        return [pattern]
    return [Path(name) for name in sorted(glob.glob(str(pattern), recursive=True))] or [pattern]


def read_recording(path: Path, options: argparse.Namespace) -> Recording:
    """Read a recording with the options of :func:`add_reading`, and print its notes."""
    recording = load_recording(path, **reading_options(options))
    for note in recording.notes:
        print_error(f"reframe-jax: {path}: {note}")
    return recording
