"""Options of ``reframe-jax identify`` that write robot descriptions, task frames and tables."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from reframe_jax.cli.outputs import check_file, path_of
from reframe_jax.cli.printing import fail, print_error
from reframe_jax.export.columns import Columns, write_csv, write_parquet
from reframe_jax.export.mjcf import to_mjcf
from reframe_jax.export.robots import check_writable
from reframe_jax.export.sdf import to_sdf
from reframe_jax.export.task_frame import TaskFrame, to_task_frame
from reframe_jax.export.urdf import to_urdf
from reframe_jax.identification.results import Identification
from reframe_jax.joints.joint import Joint
from reframe_jax.recordings.recording import Recording, RecordingError

_ROBOTS: dict[str, Callable[[Joint], str]] = {"urdf": to_urdf, "mjcf": to_mjcf, "sdf": to_sdf}
_YAML, _JSON = TaskFrame.to_yaml, TaskFrame.to_json
_DOCUMENTS: dict[str, Callable[[TaskFrame], str]] = {".yaml": _YAML, ".yml": _YAML, ".json": _JSON}
_TABLES = {"csv": write_csv, "parquet": write_parquet}


def add_exports(command: argparse.ArgumentParser) -> None:
    """Add the options that write robot descriptions, task frames and tables to a command."""
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


def check_exports(options: argparse.Namespace) -> None:
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


def write_joint_files(recording: Recording, found: Identification, options: argparse.Namespace) -> None:
    """Write the requested joint and task frame files; raise one RecordingError for all errors."""
    texts: dict[Path, Callable[[], str]] = {}
    problems = []
    robots = [name for name in _ROBOTS if getattr(options, name) is not None]
    if robots:
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


def write_tables(tables: list[Columns], options: argparse.Namespace) -> int:
    """Write the requested tables of all recordings, and print the errors; return the exit code."""
    failed = 0
    for name, write in _TABLES.items():
        out = getattr(options, name)
        try:
            if out is not None and tables:
                write(out, tables)
            elif out is not None:
                failed = fail(f"{out}: not written: no recording has a result.")
        except ImportError as error:
            failed = fail(error)
        except OSError as error:
            failed = fail(f"{out}: cannot be written: {error.strerror}.")
    return failed
