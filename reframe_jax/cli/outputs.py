"""Write the JSON documents and pictures of a command."""

import argparse
import importlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from reframe_jax.cli.printing import print_result
from reframe_jax.cli.reading import expand
from reframe_jax.export.json import to_document
from reframe_jax.recordings.recording import RecordingError, writing


def add_outputs(command: argparse.ArgumentParser, *, plot: bool = True) -> None:
    """Add the recordings, ``files``, and the options ``--json`` and ``--plot`` to a command."""
    add = command.add_argument
    add("files", nargs="+", type=Path, metavar="FILE", help="recordings")
    add("--json", metavar="OUT", help="write the results as JSON; - prints them instead of tables")
    if plot:
        add("--plot", type=Path, metavar="OUT.png", help="draw the result; of several files, to OUT-NAME.png")
    command.set_defaults(plot=None)


def check_outputs(options: argparse.Namespace) -> None:
    """Find the files of patterns, and exit with a usage error if an output cannot be written or drawn."""
    options.files = expand(options.files)
    if options.json not in (None, "-"):
        check_file("--json", Path(options.json), options)
    out: Path | None = options.plot
    if out is None:
        return
    check_file("--plot", out, options, (".png", ".pdf", ".svg", ".jpg", ".webp"))
    if len({path.stem for path in options.files}) < len(options.files):
        options.usage_error("--plot needs recordings with different names.")


def check_file(option: str, out: Path, options: argparse.Namespace, endings: Collection[str] = ()) -> None:
    """Exit with a usage error if no file can be created at the path of an option, or for another ending."""
    if out.is_dir():
        options.usage_error(f"{option} must name a file; {out} is a directory.")
    if not out.parent.is_dir():
        options.usage_error(f"{option}: there is no directory {out.parent}.")
    files = [path for path in getattr(options, "files", [getattr(options, "file", None)]) if path is not None]
    if out.exists() and any(path.exists() and out.samefile(path) for path in files):
        options.usage_error(f"{option} would replace the recording {out}.")
    others = vars(options).setdefault("outputs", {})
    if others.setdefault(out, option) != option:
        options.usage_error(f"{others[out]} and {option} name the same file, {out}.")
    if endings and out.suffix.lower() not in endings:
        options.usage_error(f"{option} must end in {', '.join(endings)}, not {out.name!r}.")


def path_of(out: Path, recording: Path, options: argparse.Namespace) -> Path:
    """Return the path of the output of one recording; with several recordings, with the recording's name."""
    return out.with_stem(f"{out.stem}-{recording.stem}") if len(options.files) > 1 else out


def write_document(records: list[dict[str, Any]], schema: str, options: argparse.Namespace) -> int:
    """Write or print the requested JSON document of all recordings; return the exit code of the command."""
    if options.json == "-":
        print_result(to_document(records, schema))
    elif options.json is not None:
        with writing(out := Path(options.json)):
            out.write_text(to_document(records, schema) + "\n", encoding="utf-8")
    return int(any(record["error"] is not None for record in records))


def draw(make: Callable[[Any], Any], recording: Path, options: argparse.Namespace) -> None:
    """Save the figure that a function makes with :mod:`reframe_jax.plotting`, or raise a RecordingError."""
    out = path_of(options.plot, recording, options)
    try:
        figure = make(importlib.import_module("reframe_jax.plotting"))
    except ImportError as error:
        raise RecordingError(str(error)) from error
    try:
        figure.savefig(out)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{out}: cannot be written: {reason}.") from error
