"""Simulate demonstrations: a hand guides a Franka arm under a constraint.

A folder stores any number of demonstrations, in parts of limited size; repeat
the command, or increase --count, to resume. An .npz stores all demonstrations
in one file (times, poses, exact_poses, joint_positions, ..., and the true
frames). With .csv, each demonstration becomes a recording for reframe-jax
identify (demos-000.csv and so on).
"""

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from reframe_jax.cli import arguments
from reframe_jax.cli.outputs import check_file
from reframe_jax.cli.printing import fail, print_result
from reframe_jax.constraints.catalogue import CONSTRAINTS
from reframe_jax.recordings.recording import writing
from reframe_jax.recordings.writing import save_recording

_LONGEST = 100_000  # largest number of samples in a demonstration
_CHUNK = 64  # demonstrations simulated in one call, and stored in one part of a folder
_ENDINGS = {"out": (".npz", ".csv"), "plot": (".png", ".pdf", ".svg"), "render": (".gif", ".mp4")}


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the demonstrations and of the files."""
    arguments.add_demonstrations(command)
    add = command.add_argument
    add("--count", type=arguments.count, default=1, metavar="N", help="number (1); in a folder, parts of 64")
    add("--out", type=Path, required=True, metavar="PATH", help="folder, .npz or .csv")
    add("--duration", type=arguments.seconds, default=5.0, metavar="S", help="duration, s (5)")
    add("--dt", type=arguments.seconds, default=0.05, metavar="S", help="sample time, s (0.05)")
    add("--plot", type=Path, metavar="FILE", help="draw the first demonstration, .png or .pdf")
    add("--render", type=Path, metavar="FILM", help="film the first demonstration, .gif or .mp4")
    add("--keep", action="store_true", help="keep demonstrations that reach a joint limit")


def run(options: argparse.Namespace) -> int:
    """Simulate and store the demonstrations."""
    _check(options)
    common = arguments.prepare_demonstrations(options)
    from reframe_jax.simulation import arm

    common |= {"redraw": not options.keep, "duration": options.duration, "dt": options.dt}
    given = options.constraint, jax.random.key(options.seed), options.count
    try:
        with writing(options.out):
            if options.out.suffix:
                drawn = list(arm.demonstrations(*given, chunk=min(options.count, _CHUNK), **common))
                written, parts = _write(options.out, drawn), iter(drawn)
            else:
                arm.store_demonstrations(*given, options.out, chunk=_CHUNK, **common)
                written, parts = str(options.out), arm.stored_demonstrations(options.out)
    except ValueError as error:
        return fail(error)
    first, codes = None, Counter[int]()
    for part in parts:
        first = part[0] if first is None and len(part.status_code) else first
        codes.update(part.status_code.tolist())
    assert first is not None  # --count is positive
    print_result(f"{written}: {codes.total()} demonstrations of {first.times[-1]:g} s")
    for code in sorted(codes.keys() - {arm.RolloutStatus.OK}):
        print_result(f"{codes[code]} of them: {arm.RolloutStatus(code).message}")
    return _draw(first, options)


def _check(options: argparse.Namespace) -> None:
    """Exit with a usage error if an output cannot be written, before the simulation starts."""
    for name, endings in _ENDINGS.items():
        path = getattr(options, name)
        if path is not None and (name != "out" or path.suffix):  # --out without a suffix is a folder
            check_file(f"--{name}", path, options, endings)
    if options.dt > options.duration:
        options.usage_error("--dt must not be longer than --duration.")
    if options.duration > _LONGEST * options.dt:
        options.usage_error(f"--duration must be at most {_LONGEST} times --dt.")


def _draw(first: Any, options: argparse.Namespace) -> int:
    """Draw the requested picture and film of one demonstration."""
    failed = 0
    try:
        if options.plot is not None:
            from reframe_jax.plotting.arm import plot_demonstration

            title = CONSTRAINTS[options.constraint].name
            plot_demonstration(first, arm=options.robot, title=title).savefig(options.plot)
            print_result(str(options.plot))
    except (ImportError, ValueError, OSError) as error:
        failed = fail(f"no picture: {error}")
    try:
        if options.render is not None:
            from reframe_jax.simulation.arm.render import film_frames, save_film

            pictures = film_frames(first.joint_positions, first.truth, arm=options.robot)
            save_film(options.render, pictures, rate=1 / options.dt)
            print_result(str(options.render))
    except (ImportError, AttributeError, ValueError, OSError, RuntimeError) as error:  # MuJoCo without OpenGL
        failed = fail(f"no film: {error}")
    return failed


def _write(path: Path, parts: list[Any]) -> str:
    """Write demonstrations; return the names of the files."""
    from reframe_jax.simulation.arm.collection import to_arrays

    times = parts[0].times
    if path.suffix.lower() == ".csv":
        poses = np.concatenate([part.poses for part in parts])
        width = max(3, len(str(len(poses) - 1)))
        files = [path.with_stem(f"{path.stem}-{number:0{width}}") for number in range(len(poses))]
        files = files if len(files) > 1 else [path]
        for file, recording in zip(files, poses, strict=True):
            save_recording(file, times, recording)
        return " to ".join(map(str, files[:: max(1, len(files) - 1)]))
    made = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    with path.open("wb") as stream:
        np.savez_compressed(stream, **to_arrays(replace(made, times=times)))
    return str(path)
