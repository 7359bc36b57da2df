"""Commands that simulate the arm: demonstrate and reproduce. MuJoCo is imported when they run."""

import argparse
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from reframe_jax import cli_arguments
from reframe_jax.frames import CONSTRAINTS
from reframe_jax.io import save_recording

__all__ = ["add_commands"]

_CHUNK = 64  # demonstrations simulated at once, and drawn for a part of a folder

_DEMONSTRATE = """\
Simulate demonstrations: a hand guides a Franka arm under a constraint.

Into a folder they go in parts of bounded size, any number of them; the same
command, or one with a larger count, goes on where an earlier one stopped. An
.npz holds all (times, poses, exact_poses, joint_positions, ..., and the true
frame of each). A .csv is one recording for each, demos-000.csv and so on, for
reframe-jax identify.
"""

_REPRODUCE = """\
Demonstrate, identify, and reproduce a task from end-stop to end-stop.

The robot is moved by wrenches in the true frames of the constraint, in frames
with the errors that methods with prior knowledge report, and in the frames it
identified: the three rows of the paper's Figure 5.
"""


def add_commands(commands: Any) -> None:
    """Add the commands of this module to those of the command line."""
    from reframe_jax import cli

    command = cli._add_command(
        commands, "demonstrate", _demonstrate, _DEMONSTRATE, "simulate demonstrations on a robot arm"
    )
    _add_common(command)
    add = command.add_argument
    add("--count", type=cli_arguments.count, default=1, metavar="N", help="demonstrations (1)")
    add("--out", type=Path, required=True, metavar="PATH", help="folder, .npz or .csv")
    add("--duration", type=cli_arguments.positive, default=5.0, metavar="S", help="s (5)")
    add("--dt", type=cli_arguments.positive, default=0.05, metavar="S", help="sample time, s (0.05)")
    add("--plot", type=Path, metavar="FILE", help="draw the first demonstration, .png or .pdf")
    add("--render", type=Path, metavar="FILM", help="film the first demonstration, .gif or .mp4")
    add(
        "--skin",
        type=Path,
        metavar="PATH",
        help="what the film shows: an MJCF of the robot that you have, such as MuJoCo Menagerie's panda.xml, "
        "or a folder of meshes, link0.stl to link7.stl and hand.stl (plain shapes)",
    )
    add("--keep", action="store_true", help="keep demonstrations that hit a limit, instead of redrawing")
    command = cli._add_command(
        commands, "reproduce", _reproduce, _REPRODUCE, "demonstrate, identify and reproduce a task"
    )
    _add_common(command)
    add = command.add_argument
    add(
        "--trials",
        type=cli_arguments.count,
        default=30,
        metavar="N",
        help="demonstrations and reproductions (30)",
    )
    add(
        "--controller",
        choices=["wrench", "hybrid", "impedance"],
        default="wrench",
        help="constant wrenches as in the paper, hybrid force/velocity, or impedance by axis (wrench)",
    )


def _add_common(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    cli_arguments.add_constraint(command)
    add("--robot", choices=["panda", "fr3"], default="panda", help="the arm: fr3 is the paper's (panda)")
    add(
        "--imperfections",
        choices=["none", "encoder", "realistic", "matched"],
        default="realistic" if command.prog.endswith("reproduce") else "encoder",
        help="of the robot: none, the noise of its encoders, that and compliance, or as much compliance as "
        "the paper's set-up shows (%(default)s)",
    )
    add(
        "--excitation",
        choices=["exciting", "brisk", "paper"],
        default="exciting",
        help="how the hand moves along the free axes: of many frequencies, the same with hinges as fast as "
        "in the paper's Table 4, or as in the paper's simulations (exciting)",
    )
    add("--fixed", action="store_true", help="the same geometry every time, not one drawn at random")
    cli_arguments.add_seed(command)


def _prepared(options: argparse.Namespace) -> dict[str, Any]:
    """Options that both commands pass on, after JAX has been configured."""
    from reframe_jax import cli

    cli._configure_jax(options.cache)
    from reframe_jax import panda

    kinds = {
        "none": panda.Imperfections(),
        "encoder": panda.ENCODER_GRADE,
        "realistic": panda.REALISTIC,
        "matched": panda.MATCHED,
    }
    return {
        "imperfections": kinds[options.imperfections],
        "excitation": options.excitation,
        "spread": (0.0, 0.0) if options.fixed else panda.SPREAD,
        "arm": options.robot,
        "progress": _progress if sys.stderr.isatty() else None,
    }


def _progress(done: int, count: int) -> None:
    from reframe_jax import cli

    cli._say(f"\r{done} of {count} demonstrations", end="\n" if done == count else "")


def _demonstrate(options: argparse.Namespace) -> int:
    from reframe_jax import cli

    _check(options)
    try:
        common = _prepared(options)
    except ImportError as error:
        cli._say(f"reframe-jax: error: {error}")
        return 1
    from reframe_jax import panda

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
        cli._say(f"reframe-jax: error: {options.out}: cannot be written: {error.strerror}.")
        return 1
    except ValueError as error:
        cli._say(f"reframe-jax: error: {error}")
        return 1
    first, codes = None, Counter[int]()
    for part in parts:
        first = part[0] if first is None and len(part.status_code) else first
        codes.update(part.status_code.tolist())
    assert first is not None  # there is at least one
    print(f"{written}: {codes.total()} demonstrations of {first.times[-1]:g} s")
    for code in sorted(codes.keys() - {panda.RolloutStatus.OK}):
        print(f"{codes[code]} of them: {panda.RolloutStatus(code).message}")
    return _draw(first, options)


def _check(options: argparse.Namespace) -> None:
    """Refuse, before anything is simulated, what could not be written after it."""
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
    if options.skin is not None and options.render is None:
        options.usage_error("--skin needs --render.")
    if options.dt > options.duration:
        options.usage_error("--dt must not be longer than --duration.")


def _draw(first: Any, options: argparse.Namespace) -> int:
    """The picture and the film that were asked for, of one demonstration."""
    from reframe_jax import cli

    failed = False
    try:
        if options.plot is not None:
            from reframe_jax.plotting.panda import plot_demonstration

            title = CONSTRAINTS[options.constraint].name
            plot_demonstration(first, arm=options.robot, title=title).savefig(options.plot)
            print(options.plot)
    except (ImportError, ValueError, OSError) as error:
        failed = True
        cli._say(f"reframe-jax: error: no picture: {error}")
    try:
        if options.render is not None:
            from reframe_jax.panda.render import film_frames, save_film

            pictures = film_frames(first.joint_positions, first.truth, arm=options.robot, skin=options.skin)
            save_film(options.render, pictures, rate=1 / options.dt)
            print(options.render)
    except (ValueError, OSError, RuntimeError) as error:
        failed = True
        cli._say(f"reframe-jax: error: no film: {error}")
    return int(failed)


def _write(path: Path, parts: list[Any]) -> str:
    """Write demonstrations; returns the names of the files."""
    from reframe_jax.panda.store import to_arrays

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


def _reproduce(options: argparse.Namespace) -> int:
    from reframe_jax import cli

    try:
        common = _prepared(options)
    except ImportError as error:
        cli._say(f"reframe-jax: error: {error}")
        return 1
    from reframe_jax import reproduction
    from reframe_jax.panda import RolloutStatus

    controllers = {
        "wrench": reproduction.constant_wrench(),
        "hybrid": reproduction.hybrid(),
        "impedance": reproduction.axis_impedance(),
    }
    try:
        comparison = jax.device_get(
            reproduction.compare(
                options.constraint,
                jax.random.key(options.seed),
                options.trials,
                controller=controllers[options.controller],
                **common,
            )
        )
    except ValueError as error:
        cli._say(f"reframe-jax: error: {error}")
        return 1
    print(f"{CONSTRAINTS[options.constraint].name}, {options.trials} trials, {options.controller}")
    print(_errors(comparison.errors))
    if comparison.redrawn:
        print(f"left out, as out of the arm's reach in the true frame too: {int(comparison.redrawn)}")
    print(f"{'frames':12}{'completed':>10}{'time, s':>9}{'peak moment, N m':>22}{'peak force, N':>20}")
    for name, trials in comparison.rows.items():
        cells = [
            f"{np.mean(peak):.2f} ± {np.std(peak):.2f}" for peak in (trials.peak_moment, trials.peak_force)
        ]
        time = np.median(trials.completion_time)
        print(f"{name:12}{100 * np.mean(trials.completed):>8.0f} %{time:>9.2f}{cells[0]:>22}{cells[1]:>20}")
    for name in ("literature", "identified"):
        excess = [f"{np.mean(e):+.2f} ± {np.std(e):.2f}" for e in comparison.excess(name)]
        print(f"{name + ' over exact':31}{excess[0]:>22}{excess[1]:>20}")
    if not np.all(comparison.identified.completed):
        codes = np.unique(comparison.identified.status_code[~comparison.identified.completed])
        why = " ".join(RolloutStatus(code).message for code in codes if code)
        cli._say(f"reframe-jax: some trials in identified frames did not arrive at the end-stop. {why}")
    return 0


def _errors(errors: np.ndarray) -> str:
    """Medians of the geometric errors, of those that the constraint has."""
    names = (("angular axis", "deg"), ("linear axis", "deg"), ("position", "mm"))
    parts = [
        f"{name} {np.median(column):.2f} {unit}"
        for (name, unit), column in zip(names, errors.T, strict=True)
        if not np.isnan(column).any()
    ]
    return f"median errors of the identified frames: {', '.join(parts) or 'none to tell'}"
