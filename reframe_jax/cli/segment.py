"""``reframe-jax segment``: the sequence of constraints in recordings."""

import argparse
from pathlib import Path
from typing import Any

from reframe_jax.cli import arguments
from reframe_jax.cli.commands import add_command
from reframe_jax.cli.configuring import configure_jax
from reframe_jax.cli.identify import check_plot
from reframe_jax.cli.speaking import say, show
from reframe_jax.export.segments import segments_to_json, segments_to_record, segments_to_table
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording, RecordingError
from reframe_jax.segmentation.entry import segment
from reframe_jax.segmentation.results import Segmentation

__all__ = ["add_segment"]

_SEGMENT = """\
Find where the constraint of a recording changes, and identify every part.

Recordings are those of reframe-jax identify. Each row is a segment, and has the
label of its constraint: the same where the same constraint comes back. After
"since" is when the segment may have begun, and the probability that it differs
from the one before.
"""


def add_segment(commands: Any) -> None:
    """Add the command to those of the command line."""
    command = add_command(commands, "segment", _segment, _SEGMENT)
    add = command.add_argument
    add("files", nargs="+", type=Path, metavar="FILE", help="recordings")
    add("--dt", type=arguments.seconds, metavar="S", help="sample time in s, for files without times")
    add("--unit", choices=["m", "cm", "mm"], default="m", help="unit of positions in the files (m)")
    add(
        "--lag",
        type=arguments.count,
        metavar="L",
        help="samples between the two poses of a velocity (as many as the noise requires)",
    )
    add(
        "--reach",
        type=arguments.metres,
        default=1.0,
        metavar="M",
        help="how far from the body positions are searched, in m (%(default)s)",
    )
    add("--json", metavar="OUT", help="write the results as JSON; - prints them instead of tables")
    add(
        "--plot",
        type=Path,
        metavar="OUT.png",
        help="draw the result; of several recordings, to OUT-NAME.png each",
    )


def _segment(options: argparse.Namespace) -> int:
    if options.plot is not None:
        check_plot(options)
        if len({path.stem for path in options.files}) < len(options.files):
            options.usage_error("--plot needs recordings with different names.")
    configure_jax(options.cache)
    records = [_segment_file(path, options) for path in options.files]
    failed = any(record["error"] is not None for record in records)
    try:
        if options.json == "-":
            show(segments_to_json(records))
        elif options.json is not None:
            Path(options.json).write_text(segments_to_json(records) + "\n", encoding="utf-8")
    except OSError as error:
        say(f"reframe-jax: error: {options.json}: cannot be written: {error.strerror}.")
        failed = True
    return int(failed)


def _segment_file(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Segment, print and draw one recording; returns its entry in the JSON document."""
    found, problem = None, None
    try:
        recording = load_recording(path, unit=options.unit, dt=options.dt)
        for note in recording.notes:
            say(f"reframe-jax: {path}: {note}")
        found = segment(recording.poses, times=recording.times, lag=options.lag, reach=options.reach)
        if options.json != "-":
            show(segments_to_table(found, label=str(path)), end="\n\n")
        if options.plot is not None:
            problem = _plot(recording, found, options)
    except RecordingError as error:
        problem = str(error)
    except ValueError as error:
        problem = f"{path}: {error}"
    if problem is not None:
        say(f"reframe-jax: error: {problem}")
    return segments_to_record(found, label=str(path), error=problem)


def _plot(recording: Recording, found: Segmentation, options: argparse.Namespace) -> str | None:
    """Draw a recording; returns what is wrong if it cannot be drawn."""
    from reframe_jax.plotting import plot_segmentation

    out: Path = options.plot
    if len(options.files) > 1:
        out = out.with_stem(f"{out.stem}-{recording.path.stem}")
    try:
        plot_segmentation(recording.poses, found, title=recording.path.name).savefig(out)
    except ImportError as error:
        return str(error)
    except (OSError, ValueError) as error:
        return f"{out}: cannot be written: {getattr(error, 'strerror', None) or error}."
    return None
