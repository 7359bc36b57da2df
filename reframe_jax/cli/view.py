"""Show a recording and its constraint in the browser.

The page shows the body, its path, the frame with its free and constrained axes,
and the velocities along these axes; a slider selects the time. The page is
served on this machine only (127.0.0.1) until Ctrl-C, and needs no network.
--html writes the page as one file instead, which opens in any browser without
Python.
"""

import argparse
import webbrowser
from contextlib import closing
from pathlib import Path

import jax
import numpy as np

from reframe_jax.cli import arguments
from reframe_jax.cli.identify import add_windows, check_windows, identify_recording
from reframe_jax.cli.outputs import check_file
from reframe_jax.cli.printing import fail, print_result
from reframe_jax.cli.reading import add_reading, read_recording
from reframe_jax.motion.windows import sliding_windows
from reframe_jax.recordings.recording import writing
from reframe_jax.viewer import Page, WindowTrack, track_window, write_page


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the file and the options of the page."""
    add = command.add_argument
    add("file", type=Path, metavar="FILE", help="recording, in a format that identify reads")
    add("--scales", type=arguments.scales, default="auto", metavar="N,N", help="as for identify (auto)")
    add("--assume", type=arguments.assumed, metavar="NAME", help="as for identify")
    add_windows(command)
    port = "port of the page; if it is in use, the next free port (8080)"
    add("--port", type=arguments.count, default=8080, metavar="P", help=port)
    add("--open", action="store_true", help="open the page in the browser")
    add("--html", type=Path, metavar="OUT", help="write the page to a file instead")
    add_reading(command)
    arguments.add_cache(command)
    # options of identify that this command does not offer
    command.set_defaults(norm=0.0, discretization="chord", bounds=None)
    command.set_defaults(angular_threshold=None, linear_threshold=None)


def run(options: argparse.Namespace) -> int:
    """Identify the recording, and serve or write the page."""
    check_windows(options)
    if options.port > 65535:
        options.usage_error(f"--port must be at most 65535, not {options.port}.")
    if options.html is not None:
        check_file("--html", options.html, options)
    arguments.configure_jax(options.cache)
    try:
        tracks = _tracks(options)
        if options.html is None:
            page = Page(tracks, title=options.file.name, port=options.port)
            print_result(f"{options.file}: {page.url} (Ctrl-C ends it)")
            if options.open:
                webbrowser.open(page.url)
            with closing(page):
                page.run()
        else:
            with writing(options.html):
                write_page(options.html, tracks, title=options.file.name)
            print_result(f"{options.html}: {tracks[0].name}{', and more windows' if len(tracks) > 1 else ''}")
    except (ImportError, OSError) as error:
        return fail(error)
    return 0


def _tracks(options: argparse.Namespace) -> list[WindowTrack]:
    from reframe_jax.uncertainty.covariance import covariance

    recording = read_recording(options.file, options)
    found, spans = identify_recording(recording, options)
    poses, times = recording.poses, recording.times
    if options.window is None:
        spread = np.asarray(covariance(found, poses, times=times, scales=options.scales).position)[None]
        found = jax.tree.map(lambda leaf: np.asarray(leaf)[None], found)
    else:
        places, instants = (sliding_windows(x, options.window, options.stride) for x in (poses, times))
        spread = np.asarray(covariance(found, places, times=instants, scales=options.scales).position)
    tracks = []
    for index, span in enumerate(spans):
        rows = slice(span.start, span.stop)
        one = jax.tree.map(jax.numpy.asarray, found[index])
        known = spread[index] if np.isfinite(spread[index]).all() else None
        tracks.append(track_window(poses[rows], times[rows], one, covariance=known))
    return tracks
