"""Arguments of the command line: what is wrong with one is said in one line."""

import argparse
from pathlib import Path
from typing import NoReturn

import numpy as np

from reframe_jax.classify import Thresholds
from reframe_jax.frames import constraint
from reframe_jax.objectives import check_exponent

__all__ = [
    "Parser",
    "add_constraint",
    "add_identify",
    "add_seed",
    "add_simulate",
    "count",
    "positive",
    "whole",
]


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as everything else here does, and where to read more."""

    def error(self, message: str) -> NoReturn:
        """Leave with code 2."""
        self.exit(2, f"{self.prog}: error: {message.rstrip('.')}; see {self.prog} --help\n")


def number(text: str) -> float:
    """A number."""
    try:
        return float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a number, not {text!r}") from error


def whole(text: str) -> int:
    """A whole number."""
    try:
        return int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"expected a whole number, not {text!r}") from error


def positive(text: str) -> float:
    """A finite number above 0."""
    value = number(text)
    if not 0 < value < np.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number, not {text}")
    return value


def not_negative(text: str) -> float:
    """A finite number, 0 or more."""
    value = number(text)
    if not 0 <= value < np.inf:
        raise argparse.ArgumentTypeError(f"expected a number that is 0 or more, not {text}")
    return value


def count(text: str) -> int:
    """A positive whole number."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a positive whole number, not {text}")
    return int(text)


def seed(text: str) -> int:
    """A seed that JAX takes."""
    value = whole(text)
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to 2^63 - 1, not {text}")
    return value


def exponent(text: str) -> float:
    """An exponent of the norm over axes."""
    try:
        return check_exponent(number(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def label(text: str) -> str:
    """The letter of a constraint, from that or its name."""
    try:
        return constraint(text).label
    except KeyError as error:
        raise argparse.ArgumentTypeError(error.args[0]) from error


def add_constraint(command: argparse.ArgumentParser) -> None:
    """The option ``--constraint``."""
    command.add_argument(
        "--constraint", type=label, required=True, metavar="K", help="letter or name: see constraints"
    )


def add_seed(command: argparse.ArgumentParser) -> None:
    """The option ``--seed``."""
    command.add_argument("--seed", type=seed, default=0, metavar="N", help="of the random numbers (0)")


def add_identify(command: argparse.ArgumentParser) -> None:
    """The options of ``identify``."""
    defaults = Thresholds()
    add = command.add_argument
    add("files", nargs="+", type=Path, metavar="FILE", help="recordings")
    add("--dt", type=positive, metavar="S", help="sample time in s, for files without times")
    add("--clean", action="store_true", help="leave out outliers, noise and rest; says what it left out")
    add(
        "--step",
        type=positive,
        metavar="S",
        help="with --clean: s between poses (chosen from the noise)",
    )
    add("--unit", choices=["m", "cm", "mm"], default="m", help="unit of positions in the files (m)")
    add("--window", type=whole, metavar="N", help="poses per window; the whole recording by default")
    add("--stride", type=whole, metavar="M", help="poses between the starts of two windows (N)")
    add(
        "--norm",
        type=exponent,
        default=0.0,
        metavar="P",
        help="exponent of the power mean over the axes, up to 2; --norm=-inf for the minimum (0)",
    )
    add(
        "--discretization",
        choices=["chord", "left"],
        default="chord",
        help="velocity from two poses: chord for measured motion, left as in the paper (chord)",
    )
    add(
        "--angular-threshold",
        type=positive,
        default=defaults.angular,
        metavar="W",
        help="rad/s rms above which a rotation is free (%(default)s)",
    )
    add(
        "--linear-threshold",
        type=positive,
        default=defaults.linear,
        metavar="V",
        help="m/s rms above which a translation is free (%(default)s)",
    )
    add(
        "--bounds",
        type=positive,
        default=1.0,
        metavar="M",
        help="how far positions are searched, in m (%(default)s)",
    )
    add("--json", metavar="OUT", help="write the results as JSON; - prints them instead of tables")
    add(
        "--plot",
        type=Path,
        metavar="OUT.png",
        help="draw the result; of several recordings, to OUT-NAME.png each",
    )


def add_simulate(command: argparse.ArgumentParser) -> None:
    """The options of ``simulate``."""
    add = command.add_argument
    add_constraint(command)
    add("--out", type=Path, required=True, metavar="FILE", help="recording to write, .csv or .npz")
    add(
        "--noise",
        type=not_negative,
        default=0.0,
        metavar="M",
        help="standard deviation of positions, m (0)",
    )
    add_seed(command)
    add("--duration", type=positive, default=5.0, metavar="S", help="s (5)")
    add("--dt", type=positive, default=0.1, metavar="S", help="sample time, s (0.1)")
    add(
        "--excitation",
        choices=["exciting", "paper"],
        default="exciting",
        help="velocities along the free axes: of many frequencies, or those of the paper (exciting)",
    )
    add(
        "--generator",
        choices=["exact", "paper"],
        default="exact",
        help="motion between the samples: exact, or one step per sample as in the paper (exact)",
    )
