"""Identify the constraint in recordings.

A recording is a .csv or .tsv with a header (t,x,y,z,qx,qy,qz,qw in any order),
a TUM trajectory (.txt, .tum), an .npy or an .npz, a ROS bag, a C3D, an export
of a motion-capture system, or a Parquet or HDF5 file. Units are metres and
seconds unless the file or an option states another unit. The whole recording is
one window; --window gives sliding windows. Patterns such as 'runs/**/*.csv' are
expanded. After several recordings, a table lists all results. The number in
parentheses after the name is its probability. An uncertain axis has the
probability that it is free, or constrained, in parentheses.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from reframe_jax.cli import arguments
from reframe_jax.cli.outputs import add_outputs, check_file, check_outputs, draw, path_of, write_document
from reframe_jax.cli.printing import fail, print_error, print_result
from reframe_jax.cli.reading import add_reading, read_recording
from reframe_jax.export.columns import Columns, to_columns, write_csv, write_parquet
from reframe_jax.export.common import Window, align_columns, format_probability
from reframe_jax.export.json import SCHEMA, to_record
from reframe_jax.export.mjcf import to_mjcf
from reframe_jax.export.robots import check_writable
from reframe_jax.export.sdf import to_sdf
from reframe_jax.export.table import rows_to_table, to_table
from reframe_jax.export.task_frame import TaskFrame, to_task_frame
from reframe_jax.export.urdf import to_urdf
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.entry import identify
from reframe_jax.identification.results import Identification
from reframe_jax.joints.joint import Joint
from reframe_jax.motion.checks import MIN_VELOCITIES, Status
from reframe_jax.motion.windows import sliding_windows
from reframe_jax.recordings.recording import Recording, RecordingError, writing
from reframe_jax.storage.progress import make_meter

_CHUNK = 2048  # windows per progress report
_COLUMNS = ("recording", "windows", "name", "prob.", "angular", "linear", "origin [m]", "noise", "status")
_ROBOTS: dict[str, Callable[[Joint], str]] = {"urdf": to_urdf, "mjcf": to_mjcf, "sdf": to_sdf}
_DOCUMENTS = {".yaml": TaskFrame.to_yaml, ".yml": TaskFrame.to_yaml, ".json": TaskFrame.to_json}
_TABLES = {"csv": write_csv, "parquet": write_parquet}


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the files and the options of identification."""
    defaults = Thresholds()
    add = command.add_argument
    add(
        "--scales",
        type=arguments.scales,
        default="auto",
        metavar="N,N",
        help="time scales: samples per averaged block, powers of two; 1 is the paper's scale, auto uses all "
        "scales at which the motion exceeds the noise, mean uses displacements about the mean (auto)",
    )
    assume = "fit this constraint instead of comparing all: hinge, ball, screw joint, K"
    add("--assume", type=arguments.assumed, metavar="NAME", help=assume)
    add_windows(command)
    norm = "exponent of the power mean over the axes, up to 2; --norm=-inf for the minimum (0)"
    add("--norm", type=arguments.exponent, default=0.0, metavar="P", help=norm)
    add(
        "--discretization",
        choices=["chord", "left"],
        default="chord",
        help="velocity from two poses: chord is best for measured motion, left is the paper's method (chord)",
    )
    add(
        "--angular-threshold",
        type=arguments.positive,
        metavar="W",
        help="rad/s RMS; decide by thresholds instead of probabilities: a rotation above this threshold is "
        f"free. If only --linear-threshold is given, this threshold is the paper's ({defaults.angular:g})",
    )
    linear = f"m/s RMS; as --angular-threshold, for translations ({defaults.linear:g})"
    add("--linear-threshold", type=arguments.positive, metavar="V", help=linear)
    bounds = (
        "half the width of the cube in which origins are searched, m (the larger of 2 and twice the extent "
        "of the motion)"
    )
    add("--bounds", type=arguments.metres, metavar="M", help=bounds)
    add("--summary", action="store_true", help="print only the table of all recordings")
    explain = "explain the result in plain English, with error bars (95 %%) and what to record next"
    add("--explain", action="store_true", help=explain)
    add_outputs(command)
    add_reading(command)
    add = command.add_argument_group(
        "files for other programs",
        "With several recordings, each joint or task frame is written to OUT-NAME.",
    ).add_argument
    for name in _ROBOTS:
        add(f"--{name}", type=Path, metavar="OUT", help=f"write the joint as {name.upper()}")
    frame = "write the task frame at the last pose, .yaml or .json"
    add("--task-frame", type=Path, metavar="OUT", help=frame)
    add("--parent", default="ground", metavar="NAME", help="name of the ground in these files (ground)")
    add("--child", default="body", metavar="NAME", help="name of the body in these files (body)")
    add("--csv", type=Path, metavar="OUT", help="write a table of all recordings as CSV, one row per window")
    add("--parquet", type=Path, metavar="OUT", help="write the same table as Parquet")
    arguments.add_cache(command)


def _check_exports(options: argparse.Namespace) -> None:
    """Exit with a usage error if an output cannot be written, before the computation starts."""
    of_joints = [*_ROBOTS, "task_frame"]
    for name in (*of_joints, *_TABLES):
        out: Path | None = getattr(options, name)
        option = f"--{name.replace('_', '-')}"
        if out is None:
            continue
        check_file(option, out, options, _DOCUMENTS if name == "task_frame" else ())
        if name in of_joints and options.window is not None:
            options.usage_error(f"{option} describes whole recordings: remove --window.")
        if name in of_joints and len({path.stem for path in options.files}) < len(options.files):
            options.usage_error(f"{option} needs recordings with different names.")
    if not options.parent or options.parent == options.child:
        options.usage_error("--parent and --child must be two different names.")


def add_windows(command: argparse.ArgumentParser) -> None:
    """Add the options ``--window`` and ``--stride`` to a command."""
    add = command.add_argument
    add("--window", type=arguments.whole, metavar="N", help="poses per window (all)")
    add("--stride", type=arguments.whole, metavar="M", help="poses between the starts of two windows (N)")


def check_windows(options: argparse.Namespace) -> None:
    """Exit with a usage error for options that cannot be combined, and set the default stride."""
    if options.window is None:
        if options.stride is not None:
            options.usage_error("--stride needs --window.")
        options.stride = 1
    elif options.window < MIN_VELOCITIES + 1:
        options.usage_error(f"--window must be at least {MIN_VELOCITIES + 1} poses.")
    options.stride = options.window if options.stride is None else options.stride
    if options.stride < 1:
        options.usage_error("--stride must be at least 1.")


def run(options: argparse.Namespace) -> int:
    """Identify every recording, and write the requested files."""
    check_outputs(options)
    _check_exports(options)
    check_windows(options)
    for name in ("plot", "explain"):
        if getattr(options, name) and options.window is not None:
            options.usage_error(f"--{name} needs a whole recording: remove --window.")
    if options.explain and options.json == "-":
        options.usage_error("--explain prints sentences, and --json - only JSON: remove one of them.")
    arguments.configure_jax(options.cache)
    records: list[dict[str, Any]] = []
    tables: list[Columns] = []
    quiet = options.summary or options.json == "-" or not sys.stdout.isatty()
    meter = make_meter(None if quiet and len(options.files) > 1 else False, "recordings")
    for path in options.files:
        records.append(_identify_file(path, options, tables))
        meter(len(records), len(options.files))
        if quiet and sys.stderr.isatty() and len(records) < len(options.files):
            print_error("", end="\r")  # the next line overwrites the progress bar
    if options.json != "-" and (options.summary or sum(record["error"] is None for record in records) > 1):
        print_result(summary_table(records))
    failed = _write_tables(tables, options)
    return write_document(records, SCHEMA, options) or failed


def _identify_file(path: Path, options: argparse.Namespace, tables: list[Columns]) -> dict[str, Any]:
    """Identify, print, draw and export one recording, and append its columns; return its JSON entry."""
    recording, found, windows, problem = None, None, None, None
    try:
        recording = read_recording(path, options)
        found, windows = identify_recording(recording, options)
        tables.append(to_columns(found, label=str(path), windows=windows))
        _print_and_draw(recording, found, windows, options)
        if options.window is None:
            _write_joint_files(recording, found, options)
    except Exception as error:  # an error in one file must not stop the other files
        known = isinstance(error, RecordingError)
        problem = str(error) if known else f"{path}: {type(error).__name__}: {error}"
        fail(problem)
    return to_record(found, label=str(path), windows=windows, recording=recording, error=problem)


def _thresholds(options: argparse.Namespace) -> Thresholds | None:
    """Return thresholds with the paper's value for a missing one; None if both are missing."""
    given = {"angular": options.angular_threshold, "linear": options.linear_threshold}
    given = {name: value for name, value in given.items() if value is not None}
    return Thresholds(**given) if given else None


def _print_and_draw(
    recording: Recording, found: Identification, windows: list[Window], options: argparse.Namespace
) -> None:
    """Print the table, the rows that were left out, and the explanation, and draw the picture.

    The explanation has error bars if the options allow a covariance. If no window has a result, a
    RecordingError is raised.
    """
    path, statuses = recording.path, [Status(int(code)) for code in np.ravel(found.status_code)]
    for warning in found.warnings if options.window is None else []:
        print_error(f"reframe-jax: {path}: {warning}")
    if options.json != "-" and not options.summary:
        print_result(to_table(found, label=str(path), windows=windows), end="\n\n")
        if rows := rows_to_table(recording, found):
            print_result(rows, end="\n\n")
    if all(status.failed for status in statuses):
        raise RecordingError(f"{path}: {statuses[0].message}")
    if options.explain:
        from reframe_jax.uncertainty.covariance import covariance
        from reframe_jax.uncertainty.excitation import excitation

        given = {"times": recording.times, "scales": options.scales}
        usual = options.norm == 0 and options.discretization == "chord"
        spread = covariance(found, recording.poses, **given) if usual else None
        print_result(found.explain(spread, excitation(found, recording.poses, **given)), end="\n\n")
    if options.plot is not None:
        drawn = {
            "times": recording.times,
            "thresholds": _thresholds(options),
            "discretization": options.discretization,
            "title": f"{path.name}: {found.name}",
            "left_out": recording.left_out_times,
        }
        draw(lambda plot: plot.plot_identification(recording.poses, found, **drawn), path, options)


def _write_joint_files(recording: Recording, found: Identification, options: argparse.Namespace) -> None:
    """Write the requested joint and task frame files; raise one RecordingError for all errors."""
    texts: dict[Path, Callable[[], str]] = {}
    problems = []
    if robots := [name for name in _ROBOTS if getattr(options, name) is not None]:
        joint = found.to_joint(recording.poses, parent=options.parent, child=options.child)
        if joint.is_envelope:
            print_error(f"reframe-jax: {recording.path}: {joint.gauge[0]}")
        try:
            check_writable(joint, " and ".join(name.upper() for name in robots))
            texts |= {getattr(options, name): partial(_ROBOTS[name], joint) for name in robots}
        except ValueError as error:  # all formats fail for the same reason
            problems.append(f"{recording.path}: {error}")
    if options.task_frame is not None:
        last = recording.poses[np.flatnonzero(found.counted)[-1]]
        texts[options.task_frame] = lambda: _DOCUMENTS[options.task_frame.suffix.lower()](
            to_task_frame(found, last, ground=options.parent, body=options.child)
        )
    for out, make in texts.items():
        out = path_of(out, recording.path, options)
        try:
            out.write_text(make(), encoding="utf-8", errors="xmlcharrefreplace")
        except ValueError as error:
            problems.append(f"{recording.path}: {error}")
        except OSError as error:
            problems.append(f"{out}: cannot be written: {error.strerror}.")
    if problems:
        raise RecordingError("; ".join(problems))


def _write_tables(tables: list[Columns], options: argparse.Namespace) -> int:
    """Write the requested tables of all recordings, and print the errors; return the exit code."""
    failed = 0
    for name, write in _TABLES.items():
        out = getattr(options, name)
        try:
            if out is not None and tables:
                with writing(out):
                    write(out, tables)
            elif out is not None:
                failed = fail(f"{out}: not written: no recording has a result.")
        except (ImportError, RecordingError) as error:
            failed = fail(error)
    return failed


def identify_recording(
    recording: Recording, options: argparse.Namespace
) -> tuple[Identification, list[Window]]:
    """Identify all windows of a recording; without ``--window``, the whole recording is one window."""
    whole = options.window is None
    length = len(recording.times) if whole else options.window
    if length > len(recording.times):
        raise RecordingError(
            f"{recording.path}: has {len(recording.times)} poses; expected at least {length}, the length "
            "of a window."
        )
    times = sliding_windows(recording.times, length, options.stride)
    spans = [
        Window(start, start + length, float(window[0]), float(window[-1]))
        for start, window in zip(range(0, len(recording.times), options.stride), times, strict=False)
    ]
    if whole:
        try:
            return jax.device_get(_identify_windows(recording.poses, recording.times, options)), spans
        except ValueError as error:
            raise RecordingError(f"{recording.path}: {error}") from error
    poses = sliding_windows(recording.poses, length, options.stride)
    parts, meter = [], make_meter(None if len(poses) > _CHUNK else False, "windows")
    for first in range(0, len(poses), _CHUNK):
        rows = slice(first, first + _CHUNK)
        parts.append(jax.device_get(_identify_windows(poses[rows], times[rows], options)))
        meter(min(first + _CHUNK, len(poses)), len(poses))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), spans


def _identify_windows(poses: np.ndarray, times: np.ndarray, options: argparse.Namespace) -> Identification:
    same = {name: getattr(options, name) for name in ("scales", "assume", "norm", "discretization", "bounds")}
    return identify(poses, times=times, thresholds=_thresholds(options), **same)


def summary_table(records: list[dict[str, Any]]) -> str:
    """Format one row per record of :func:`.to_record`; for several windows, with the most frequent name."""
    return "\n".join(align_columns([list(_COLUMNS), *map(_summary_row, records)]))


def _summary_row(record: dict[str, Any]) -> list[str]:
    every = record["windows"]
    windows = [window for window in every if window.get("name") is not None]
    start = [str(record["recording"]), str(len(every))]
    if not windows:
        return [*start, *("-",) * 6, "error" if record["error"] else every[0]["status"]]
    if len(every) > 1:
        (name, number) = Counter(window["name"] for window in windows).most_common(1)[0]
        statuses = Counter(window["status"] for window in every).most_common()
        status_counts = ", ".join(f"{count} {status}" for status, count in statuses)
        return [*start, f"{name} ({number} of {len(every)})", *("-",) * 5, status_counts]
    (window,) = windows
    noise = window["noise"]
    return [
        *(*start, window["name"], format_probability(window["probability"])),
        *(window["angular"]["type"], window["linear"]["type"]),
        ", ".join(f"{value + 0.0:.3f}" for value in np.round(window["linear"]["position"], 3)),
        f"{1e3 * noise['position']:.2g} mm, {np.degrees(noise['rotation']):.2g} deg",
        window["status"],
    ]
