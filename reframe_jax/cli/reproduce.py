"""Demonstrate, identify, and reproduce a task from end-stop to end-stop.

Wrenches move the robot in two frames: the true frame of the constraint and the
identified frame.
"""

import argparse

import jax
import numpy as np

from reframe_jax.cli import arguments
from reframe_jax.cli.printing import fail, print_error, print_result
from reframe_jax.constraints.catalogue import CONSTRAINTS


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the demonstrations and of the controller."""
    arguments.add_demonstrations(command)
    trials = "number of demonstrations and reproductions (30)"
    command.add_argument("--trials", type=arguments.count, default=30, metavar="N", help=trials)
    command.add_argument(
        "--controller",
        choices=["wrench", "hybrid", "impedance"],
        default="wrench",
        help="constant wrenches as in the paper, hybrid force/velocity control, or impedance control with a "
        "stiffness per axis (wrench)",
    )


def run(options: argparse.Namespace) -> int:
    """Compare the two frames, and print the errors, forces and completion times."""
    common = arguments.prepare_demonstrations(options)
    from reframe_jax.simulation import reproduction
    from reframe_jax.simulation.arm import RolloutStatus

    controllers = {
        "wrench": reproduction.constant_wrench(),
        "hybrid": reproduction.hybrid(),
        "impedance": reproduction.axis_impedance(),
    }
    common |= {"controller": controllers[options.controller]}
    given = options.constraint, jax.random.key(options.seed), options.trials
    try:
        comparison = jax.device_get(reproduction.compare(*given, **common))
    except ValueError as error:
        return fail(error)
    print_result(f"{CONSTRAINTS[options.constraint].name}, {options.trials} trials, {options.controller}")
    # as far as the constraint determines them
    names = (("angular axis", "deg"), ("linear axis", "deg"), ("position", "mm"))
    errors = [
        f"{name} {np.median(column):.2f} {unit}"
        for (name, unit), column in zip(names, comparison.errors.T, strict=True)
        if not np.isnan(column).any()
    ]
    print_result(f"median errors of the identified frames: {', '.join(errors) or 'none defined'}")
    if comparison.redrawn:
        print_result(f"left out, not feasible for the arm even in the true frame: {int(comparison.redrawn)}")
    print_result(f"{'frames':12}{'completed':>10}{'time, s':>9}{'peak moment, N m':>22}{'peak force, N':>20}")
    for name, trials in comparison.rows.items():
        peaks = trials.peak_moment, trials.peak_force
        cells = [f"{np.mean(peak):.2f} ± {np.std(peak):.2f}" for peak in peaks]
        time = np.median(trials.completion_time)
        done = 100 * np.mean(trials.completed)
        print_result(f"{name:12}{done:>8.0f} %{time:>9.2f}{cells[0]:>22}{cells[1]:>20}")
    excess = [f"{np.mean(e):+.2f} ± {np.std(e):.2f}" for e in comparison.excess()]
    print_result(f"{'identified over exact':31}{excess[0]:>22}{excess[1]:>20}")
    if not np.all(comparison.identified.completed):
        codes = np.unique(comparison.identified.status_code[~comparison.identified.completed])
        why = " ".join(RolloutStatus(code).message for code in codes if code)
        print_error(f"reframe-jax: some trials in identified frames did not reach the end-stop. {why}")
    return 0
