"""The command line: identify recordings, simulate some, list the catalogue.

Results go to standard output; notes about the input, progress and errors to standard error. The exit
code is 0 if everything went well, 1 if a file failed, and 2 for a wrong command line. Everything is
computed in 64 bits.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import reframe_jax
from reframe_jax import cli_arguments as arguments
from reframe_jax import cli_panda, report
from reframe_jax.classify import Thresholds
from reframe_jax.cleaning import clean_recording, recording_warnings
from reframe_jax.frames import CONSTRAINTS
from reframe_jax.identify import identify
from reframe_jax.io import Recording, RecordingError, load_recording, save_recording
from reframe_jax.kinematics import sliding_windows
from reframe_jax.results import Identification
from reframe_jax.validate import MIN_VELOCITIES, Status

__all__ = ["main"]

_CHUNK = 2048  # windows between two reports of progress
_CLOSE = 1.5  # factor from a threshold within which an axis is neither clearly free nor constrained
_UNKNOWNS = 5  # of one constrained axis: its direction, and where the origin is

_DESCRIPTION = """\
Find the frame in which a measured motion is constrained: the body it is
attached to, where it lies, and along which axes it cannot move.
"""

_EXAMPLES = """\
examples:
  reframe-jax simulate --constraint A --noise 1e-4 --out door.csv
  reframe-jax identify door.csv --plot door.png
  reframe-jax identify *.csv --window 50 --stride 10 --json answers.json
"""

_IDENTIFY = """\
Identify the constraint of recordings.

A recording is a .csv or .tsv with a header (t,x,y,z,qx,qy,qz,qw in any order), a
TUM trajectory (.txt, .tum), an .npy or an .npz; metres and seconds unless told
otherwise. It is taken as one window, or as sliding windows with --window.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Args:
        argv: arguments, by default those of the process.

    Raises:
        SystemExit: with code 2 for a wrong command line, 0 after ``--help`` and ``--version``.
    """
    options = _parser().parse_args(argv)
    try:
        code: int = options.run(options)
    except KeyboardInterrupt:
        return 130  # as shells report it
    return code


def _parser() -> argparse.ArgumentParser:
    parser = arguments.Parser(
        prog="reframe-jax",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {reframe_jax.__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_identify(commands)
    _add_simulate(commands)
    cli_panda.add_commands(commands)
    listing = commands.add_parser("constraints", help="list the named constraints")
    listing.set_defaults(run=_constraints)
    return parser


def _add_command(commands: Any, name: str, run: Any, text: str, help: str) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        description=text,
        help=help,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument(
        "--no-cache",
        dest="cache",
        action="store_false",
        help="do not keep compiled programs for later runs (in XDG_CACHE_HOME or ~/.cache)",
    )
    command.set_defaults(run=run, usage_error=command.error)
    return command


def _add_identify(commands: Any) -> None:
    command = _add_command(
        commands, "identify", _identify, _IDENTIFY, "identify the constraint of recordings"
    )
    arguments.add_identify(command)


def _add_simulate(commands: Any) -> None:
    command = _add_command(
        commands, "simulate", _simulate, "Simulate a constrained motion.", "simulate a recording"
    )
    arguments.add_simulate(command)


def _configure_jax(cache: bool) -> None:
    """64 bits, and compiled programs kept between runs."""
    settings: dict[str, Any] = {"jax_enable_x64": True}
    if cache:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        settings["jax_compilation_cache_dir"] = str(Path(home) / "reframe-jax")
        settings["jax_persistent_cache_min_compile_time_secs"] = 0.0
        settings["jax_persistent_cache_min_entry_size_bytes"] = -1
    for name, value in settings.items():
        jax.config.update(name, value)  # type: ignore[no-untyped-call]


def _say(text: str, end: str = "\n") -> None:
    print(text, end=end, file=sys.stderr, flush=True)


def _constraints(options: argparse.Namespace) -> int:
    """The catalogue: degrees of freedom along x, y, z of the frame, and what is unique."""
    layout = "{:2} {:26} {:9} {:12} {:6} {}"
    print(layout.format("", "name", "rotation", "translation", "frame", "position"))
    for entry in CONSTRAINTS.values():
        free = ["".join(map(str, dof)) for dof in (entry.angular_dof, entry.linear_dof)]
        unique = "".join(axis for axis, is_unique in zip("xyz", entry.position, strict=True) if is_unique)
        frame = "any" if entry.linear_type is None else str(entry.linear_type)
        print(layout.format(entry.label, entry.name, *free, frame, unique or "-"))
    print("\n1 is free, 0 constrained, along x, y, z of the frame; position: its unique components.")
    return 0


def _simulate(options: argparse.Namespace) -> int:
    from reframe_jax.synthetic import simulate

    poses = round(options.duration / options.dt) + 1
    if poses <= MIN_VELOCITIES:
        options.usage_error(
            f"--duration {options.duration:g} s in steps of --dt {options.dt:g} s makes {poses} poses; "
            f"expected {MIN_VELOCITIES + 1} or more."
        )
    _configure_jax(options.cache)
    run = jax.jit(simulate, static_argnames=("constraint", "duration", "dt", "excitation", "exact"))
    simulation = jax.device_get(
        run(
            constraint=options.constraint,
            key=jax.random.key(options.seed),
            noise=options.noise,
            duration=options.duration,
            dt=options.dt,
            excitation=options.excitation,
            exact=options.generator == "exact",
        )
    )
    try:
        save_recording(options.out, simulation.times, simulation.poses)
    except RecordingError as error:
        _say(f"reframe-jax: error: {error}")
        return 1
    print(f"{options.out}: {CONSTRAINTS[options.constraint].name}, {len(simulation.times)} poses")
    return 0


def _identify(options: argparse.Namespace) -> int:
    _check(options)
    _configure_jax(options.cache)
    records, failed = [], False
    for path in options.files:
        record = _identify_file(path, options)
        records.append(record)
        failed |= record["error"] is not None
    try:
        if options.json == "-":
            print(report.to_document(records))
        elif options.json is not None:
            Path(options.json).write_text(report.to_document(records) + "\n", encoding="utf-8")
    except OSError as error:
        _say(f"reframe-jax: error: {options.json}: cannot be written: {error.strerror}.")
        failed = True
    return int(failed)


def _check(options: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    if options.step is not None and not options.clean:
        options.usage_error("--step needs --clean.")
    if options.window is None:
        if options.stride is not None:
            options.usage_error("--stride needs --window.")
        options.stride = 1
    else:
        if options.window < MIN_VELOCITIES + 1:
            options.usage_error(f"--window must be at least {MIN_VELOCITIES + 1} poses.")
        if options.plot is not None:
            options.usage_error("--plot draws whole recordings: leave out --window.")
        options.stride = options.window if options.stride is None else options.stride
    if options.stride < 1:
        options.usage_error("--stride must be at least 1.")
    stems = {path.stem for path in options.files}
    if options.plot is not None and len(stems) < len(options.files):
        options.usage_error("--plot needs recordings with different names.")


def _identify_file(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Identify, print and draw one recording; returns its entry in the JSON document."""
    recording, found, windows, problem = None, None, None, None
    try:
        recording = _load(path, options)
        recording = _noted(recording, _short_windows(recording, options))
        for note in recording.notes:
            _say(f"reframe-jax: {path}: {note}")
        found, windows = _windows(recording, options)
        close = _close_calls(found, _thresholds(options)) if options.window is None else []
        for note in close:
            _say(f"reframe-jax: {path}: {note}")
        recording = _noted(recording, close)
        problem = _print_result(path, found, windows, options)
        if options.plot is not None and problem is None:
            problem = _plot(recording, found, options)
    except RecordingError as error:
        problem = str(error)
    if problem is not None:
        _say(f"reframe-jax: error: {problem}")
    notes = recording.notes if recording else ()
    return report.to_record(found, label=str(path), windows=windows, notes=notes, error=problem)


def _load(path: Path, options: argparse.Namespace) -> Recording:
    """Load a recording and clean it, or note what is wrong with it."""
    recording = load_recording(path, unit=options.unit, dt=options.dt)
    thresholds = _thresholds(options)
    if options.clean:
        return clean_recording(recording, step=options.step, thresholds=thresholds)
    warnings = recording_warnings(recording, thresholds)
    hint = ["--clean may help: it leaves such poses out."] if warnings else []
    return replace(recording, notes=(*recording.notes, *warnings, *hint))


def _short_windows(recording: Recording, options: argparse.Namespace) -> list[str]:
    """A warning of windows in which nearly every motion obeys some constraint."""
    velocities = (options.window or len(recording.times)) - 1
    if velocities > _UNKNOWNS:
        return []
    return [
        f"{velocities} velocities say nothing: with {_UNKNOWNS} or fewer, nearly every motion has a frame in "
        "which an axis stands still. Take longer windows."
    ]


def _noted(recording: Recording, notes: list[str]) -> Recording:
    return replace(recording, notes=(*recording.notes, *notes))


def _close_calls(found: Identification, thresholds: Thresholds) -> list[str]:
    """A warning of axes so near their threshold that they are neither clearly free nor constrained."""
    close = [
        f"{group} axis {number} ({rms:.3g} {unit}, threshold {level:g})"
        for group, level, unit in (
            ("angular", thresholds.angular, "rad/s"),
            ("linear", thresholds.linear, "m/s"),
        )
        for number, rms in enumerate(np.asarray(getattr(found, group).rms), start=1)
        if level / _CLOSE < rms < level * _CLOSE
    ]
    if not close:
        return []
    return [
        f"close to the threshold, so that free or constrained is uncertain: {', '.join(close)}. Look at the "
        "gaps between the velocities, and set the thresholds into them."
    ]


def _thresholds(options: argparse.Namespace) -> Thresholds:
    return Thresholds(options.angular_threshold, options.linear_threshold)


def _print_result(
    path: Path, found: Identification, windows: list[report.Window], options: argparse.Namespace
) -> str | None:
    """Print the table; returns what is wrong if no window has a result."""
    whole = options.window is None
    statuses = [Status(int(code)) for code in np.ravel(found.status_code)]
    failed = all(status.failed for status in statuses)
    if options.json != "-" and not (failed and whole):
        print(report.to_table(found, label=str(path), windows=None if whole else windows), end="\n\n")
    return f"{path}: {statuses[0].message}" if failed else None


def _windows(recording: Recording, options: argparse.Namespace) -> tuple[Identification, list[report.Window]]:
    """Identify all windows; without --window, the whole recording as a single one."""
    whole = options.window is None
    length = len(recording.times) if whole else options.window
    if length > len(recording.times):
        raise RecordingError(
            f"{recording.path}: has {len(recording.times)} poses; expected at least the {length} of a window."
        )
    poses = sliding_windows(recording.poses, length, options.stride)
    times = sliding_windows(recording.times, length, options.stride)
    parts = []
    for first in range(0, len(poses), _CHUNK):
        rows = slice(first, first + _CHUNK)
        parts.append(jax.device_get(_identify_windows(poses[rows], times[rows], options)))
        if len(poses) > _CHUNK and sys.stderr.isatty():
            done = min(first + _CHUNK, len(poses))
            _say(f"\r{done} of {len(poses)} windows", end="\n" if done == len(poses) else "")
    found = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    spans = [
        report.Window(start, start + length, float(window[0]), float(window[-1]))
        for start, window in zip(range(0, len(recording.times), options.stride), times, strict=False)
    ]
    return (found[0] if whole else found), spans


def _identify_windows(poses: np.ndarray, times: np.ndarray, options: argparse.Namespace) -> Identification:
    return identify(
        poses,
        times=times,
        norm=options.norm,
        discretization=options.discretization,
        thresholds=_thresholds(options),
        bounds=options.bounds,
    )


def _plot(recording: Recording, found: Identification, options: argparse.Namespace) -> str | None:
    """Draw a recording; returns what is wrong if it cannot be drawn."""
    from reframe_jax.plotting import plot_identification

    out: Path = options.plot
    if len(options.files) > 1:
        out = out.with_stem(f"{out.stem}-{recording.path.stem}")
    try:
        figure = plot_identification(
            recording.poses,
            found,
            times=recording.times,
            thresholds=_thresholds(options),
            discretization=options.discretization,
            title=f"{recording.path.name}: {found.name}",
        )
    except ImportError as error:
        return str(error)
    try:
        figure.savefig(out)
    except (OSError, ValueError) as error:
        return f"{out}: cannot be written: {getattr(error, 'strerror', None) or error}."
    return None
