"""Options that select files, and the data to read from each file."""

import argparse
import glob
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from reframe_jax.cli import arguments
from reframe_jax.cli.printing import print_error
from reframe_jax.recordings.reading import TIMES_IGNORED, load_recording
from reframe_jax.recordings.recording import Recording
from reframe_jax.recordings.selection import ANGLE_UNITS, ANGLES, QUATERNIONS, TIME_UNITS, UNITS, Selection


def add_reading(command: argparse.ArgumentParser) -> None:
    """Add the options of :func:`reframe_jax.load_recording` to a command."""
    add = command.add_argument_group("data to read (reframe-jax topics FILE lists the choices)").add_argument
    add("--dt", type=arguments.seconds, metavar="S", help="sample time in s, for files without times")
    add("--unit", choices=[*UNITS], help="unit of positions, for files that do not state it (m)")
    add("--time-unit", choices=[*TIME_UNITS], help="unit of times, for files that do not state it (s)")
    add("--topic", metavar="NAME", help="topic of a bag")
    add("--from", dest="from_frame", metavar="FRAME", help="tf frame of a bag that serves as the ground")
    add("--to", dest="to_frame", metavar="FRAME", help="tf frame of a bag whose motion is read")
    add("--body", metavar="NAME", help="rigid body; for markers, a prefix of their names, or names A,B,C")
    add("--in", dest="in_body", metavar="NAME", help="body (in a bag: topic) to which the motion is relative")
    add("--position", metavar="COLUMN", help="column of positions, such as NAME or NAME[0:3], or A,B,C")
    add("--orientation", metavar="COLUMN", help="column of orientations, such as NAME[3:7]")
    add("--quaternion", choices=QUATERNIONS, help="order of the numbers of a quaternion in the file")
    how = "vector (rotation vector), XYZ etc. (about moving axes, x first), xyz etc. (about fixed axes)"
    add("--angles", choices=ANGLES, metavar="HOW", help=f"convention of three angles: {how}")
    add("--angle-unit", choices=[*ANGLE_UNITS], help="unit of the three angles (rad)")
    add("--episode", type=arguments.whole, metavar="N", help="number of the episode in a file with several")


def reading_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return the keyword arguments of :func:`reframe_jax.load_recording`."""
    return {name: getattr(options, name) for name in ("dt", *(field.name for field in fields(Selection)))}


def expand(patterns: list[Path]) -> list[Path]:
    """Return the sorted files that match patterns; a file, or a pattern without matches, is kept."""
    found: list[Path] = []
    for pattern in patterns:
        magic = glob.has_magic(str(pattern)) and not pattern.exists()
        names = sorted(glob.glob(str(pattern), recursive=True)) if magic else []
        found += [Path(name) for name in names] or [pattern]
    return found


def read_recording(path: Path, options: argparse.Namespace, *, timed: bool = True) -> Recording:
    """Read a recording with the options of :func:`add_reading`, and print its notes.

    Unless ``timed``, rows with any times are read. A RecordingError is raised if that is impossible.
    """
    chosen = reading_options(options)
    if timed or chosen["dt"] is not None or chosen["in_body"] is not None:
        recording = load_recording(path, **chosen)
    else:
        recording = load_recording(path, **(chosen | {"dt": 1.0, "time_unit": None}))
        notes = tuple(note for note in recording.notes if not note.startswith(TIMES_IGNORED))
        recording = replace(recording, notes=notes)
    for note in recording.notes:
        print_error(f"reframe-jax: {path}: {note}")
    return recording
