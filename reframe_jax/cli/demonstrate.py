"""``reframe-jax demonstrate``: simulate demonstrations on a robot arm."""

import argparse
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from reframe_jax.cli import arguments
from reframe_jax.cli.arm import add_common, prepare
from reframe_jax.cli.commands import add_command
from reframe_jax.cli.printing import print_error, print_result
from reframe_jax.constraints.catalogue import CONSTRAINTS
from reframe_jax.recordings.writing import save_recording

__all__ = ["add_demonstrate"]

_LONGEST = 100_000  # most samples in a demonstration
_CHUNK = 64  # demonstrations simulated in one call, and stored in one part of a folder


_DEMONSTRATE = """\
Simulate demonstrations: a hand guides a Franka arm under a constraint.

A folder stores any number of demonstrations, in parts of limited size; repeat
the command, or increase --count, to resume. An .npz stores all demonstrations
in one file (times, poses, exact_poses, joint_positions, ..., and the true
frames). With .csv, each demonstration becomes a recording for reframe-jax
identify (demos-000.csv and so on).
"""


def add_demonstrate(commands: Any) -> None:
    """Add this command to the command line."""
    command = add_command(commands, "demonstrate", _demonstrate, _DEMONSTRATE)
    add_common(command)
    add = command.add_argument
    add("--count", type=arguments.count, default=1, metavar="N", help="number of demonstrations (1)")
    add("--out", type=Path, required=True, metavar="PATH", help="folder, .npz or .csv")
    add("--duration", type=arguments.seconds, default=5.0, metavar="S", help="duration, s (5)")
    add("--dt", type=arguments.seconds, default=0.05, metavar="S", help="sample time, s (0.05)")
    add("--plot", type=Path, metavar="FILE", help="draw the first demonstration, .png or .pdf")
    add("--render", type=Path, metavar="FILM", help="film the first demonstration, .gif or .mp4")
    add(
        "--keep",
        action="store_true",
        help="keep demonstrations that reach a joint limit instead of replacing them",
    )


def _demonstrate(options: argparse.Namespace) -> int:
    _check(options)
    common = prepare(options)
    from reframe_jax.simulation import arm as panda

    parts: Iterable[Any]
    try:
        arguments = options.constraint, jax.random.key(options.seed), options.count
        common |= {
            "redraw": not options.keep,
            "duration": options.duration,
            "dt": options.dt,
        }
        if options.out.suffix:
            drawn = list(panda.demonstrations(*arguments, chunk=min(options.count, _CHUNK), **common))
            written, parts = _write(options.out, drawn), drawn
        else:
            panda.store_demonstrations(*arguments, options.out, chunk=_CHUNK, **common)
            written, parts = str(options.out), panda.stored_demonstrations(options.out)
    except OSError as error:
        print_error(f"reframe-jax: error: {options.out}: cannot be written: {error.strerror}.")
        return 1
    except ValueError as error:
        print_error(f"reframe-jax: error: {error}")
        return 1
    first, codes = None, Counter[int]()
    for part in parts:
        first = part[0] if first is None and len(part.status_code) else first
        codes.update(part.status_code.tolist())
    assert first is not None  # there is at least one
    print_result(f"{written}: {codes.total()} demonstrations of {first.times[-1]:g} s")
    for code in sorted(codes.keys() - {panda.RolloutStatus.OK}):
        print_result(f"{codes[code]} of them: {panda.RolloutStatus(code).message}")
    return _draw(first, options)


def _check(options: argparse.Namespace) -> None:
    """Report outputs that cannot be written, before the simulation starts."""
    endings = {"out": ("", ".npz", ".csv"), "plot": (".png", ".pdf", ".svg"), "render": (".gif", ".mp4")}
    for name, suffixes in endings.items():
        path = getattr(options, name)
        if path is None:
            continue
        if path.suffix not in suffixes:
            folder = "be a folder, or " if "" in suffixes else ""
            ends = " or ".join(filter(None, suffixes))
            options.usage_error(f"--{name} must {folder}end in {ends}, not {path.name!r}.")
        if path.suffix and not path.parent.is_dir():
            options.usage_error(f"--{name}: there is no directory {path.parent}.")
    if options.dt > options.duration:
        options.usage_error("--dt must not be longer than --duration.")
    if options.duration > _LONGEST * options.dt:
        options.usage_error(f"--duration must be at most {_LONGEST} times --dt.")


def _draw(first: Any, options: argparse.Namespace) -> int:
    """Draw the requested picture and film of one demonstration."""
    failed = False
    try:
        if options.plot is not None:
            from reframe_jax.plotting.arm import plot_demonstration

            title = CONSTRAINTS[options.constraint].name
            plot_demonstration(first, arm=options.robot, title=title).savefig(options.plot)
            print_result(str(options.plot))
    except (ImportError, ValueError, OSError) as error:
        failed = True
        print_error(f"reframe-jax: error: no picture: {error}")
    try:
        if options.render is not None:
            from reframe_jax.simulation.arm.render import film_frames, save_film

            pictures = film_frames(first.joint_positions, first.truth, arm=options.robot)
            save_film(options.render, pictures, rate=1 / options.dt)
            print_result(str(options.render))
    except (ImportError, AttributeError, ValueError, OSError, RuntimeError) as error:  # MuJoCo without OpenGL
        failed = True
        print_error(f"reframe-jax: error: no film: {error}")
    return int(failed)


def _write(path: Path, parts: list[Any]) -> str:
    """Write demonstrations; return the names of the files."""
    from reframe_jax.simulation.arm.collection import to_arrays

    times = parts[0].times
    if path.suffix == ".csv":
        poses = np.concatenate([part.poses for part in parts])
        width = max(3, len(str(len(poses) - 1)))
        files = [path.with_stem(f"{path.stem}-{number:0{width}}") for number in range(len(poses))]
        files = files if len(files) > 1 else [path]
        for file, recording in zip(files, poses, strict=True):
            save_recording(file, times, recording)
        return " to ".join(map(str, files[:: max(1, len(files) - 1)]))
    made = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    np.savez_compressed(path, **to_arrays(replace(made, times=times)))
    return str(path)
