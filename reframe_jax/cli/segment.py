"""Find the times at which the constraint changes, and identify each segment.

Segments with the same label have the same constraint. After "since", a row
shows the 95 % interval of the start of the segment, and the probability that
its constraint differs from the previous one. All formats of reframe-jax
identify can be read.
"""

import argparse
from pathlib import Path
from typing import Any

from reframe_jax.cli import arguments
from reframe_jax.cli.outputs import add_outputs, check_outputs, draw, write_document
from reframe_jax.cli.printing import fail, print_result
from reframe_jax.cli.reading import add_reading, read_recording
from reframe_jax.export.segments import SCHEMA, segments_to_record, segments_to_table
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.segmentation.entry import segment


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the files and the options of segmentation."""
    add_outputs(command)
    add_reading(command)
    arguments.add_cache(command)


def run(options: argparse.Namespace) -> int:
    """Segment every recording."""
    check_outputs(options)
    arguments.configure_jax(options.cache)
    return write_document([_segment_file(path, options) for path in options.files], SCHEMA, options)


def _segment_file(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Segment, print and draw one recording; return its entry in the JSON document."""
    found, problem = None, None
    try:
        recording = read_recording(path, options)
        found = segment(recording.poses, times=recording.times)
        if options.json != "-":
            print_result(segments_to_table(found, label=str(path)), end="\n\n")
        if options.plot is not None:
            draw(lambda plot: plot.plot_segmentation(recording.poses, found, title=path.name), path, options)
    except ValueError as error:
        problem = str(error) if isinstance(error, RecordingError) else f"{path}: {error}"
        fail(problem)
    return segments_to_record(found, label=str(path), error=problem)
