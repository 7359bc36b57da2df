"""Simulate a constrained motion, and write it as a recording."""

import argparse
from pathlib import Path

import jax

from reframe_jax.cli import arguments
from reframe_jax.cli.outputs import check_file
from reframe_jax.cli.printing import print_result
from reframe_jax.constraints.catalogue import constraint
from reframe_jax.motion.checks import MIN_VELOCITIES
from reframe_jax.recordings.recording import MOST_ROWS
from reframe_jax.recordings.writing import save_recording

_CHOICES = {
    "excitation": (["exciting", "paper"], "velocities along the free axes: many frequencies, or the paper's"),
    "generator": (["exact", "paper"], "integration between samples: exact, or one step as in the paper"),
}


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the options of the motion and of the recording."""
    add = command.add_argument
    arguments.add_constraint(command)
    add("--out", type=Path, required=True, metavar="FILE", help="recording to write, .csv or .npz")
    noise = "standard deviation of the position noise, m (0)"
    add("--noise", type=arguments.not_negative, default=0.0, metavar="M", help=noise)
    arguments.add_seed(command)
    add("--duration", type=arguments.seconds, default=5.0, metavar="S", help="duration, s (5)")
    add("--dt", type=arguments.seconds, default=0.1, metavar="S", help="sample time, s (0.1)")
    for name, (choices, text) in _CHOICES.items():
        add(f"--{name}", choices=choices, default=choices[0], help=f"{text} (%(default)s)")
    arguments.add_cache(command)


def run(options: argparse.Namespace) -> int:
    """Simulate the motion and write the recording."""
    from reframe_jax.simulation.synthetic import simulate

    check_file("--out", options.out, options, (".csv", ".npz"))
    poses = round(options.duration / options.dt) + 1
    if not MIN_VELOCITIES < poses <= MOST_ROWS:
        options.usage_error(
            f"--duration {options.duration:g} s in steps of --dt {options.dt:g} s makes {poses} poses; "
            f"expected {MIN_VELOCITIES + 1} to {MOST_ROWS}."
        )
    arguments.configure_jax(options.cache)
    compiled = jax.jit(simulate, static_argnames=("constraint", "duration", "dt", "excitation", "exact"))
    given = {name: getattr(options, name) for name in ("constraint", "noise", "duration", "dt", "excitation")}
    key, exact = jax.random.key(options.seed), options.generator == "exact"
    simulation = jax.device_get(compiled(key=key, exact=exact, **given))
    save_recording(options.out, simulation.times, simulation.poses)
    print_result(f"{options.out}: {constraint(options.constraint).name}, {len(simulation.times)} poses")
    return 0
