"""Types of command-line arguments; each error is one line."""

import argparse
from collections.abc import Callable

from reframe_jax.constraints.catalogue import CONSTRAINTS, constraint
from reframe_jax.objectives.norms import check_exponent

__all__ = [
    "add_constraint",
    "add_seed",
    "assumed",
    "count",
    "metres",
    "positive",
    "scales",
    "seconds",
    "whole",
]


_LARGEST = 1e6  # m or s: larger than any motion, and small enough for its square to be finite


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


def between(low: float, high: float, kind: str = "positive number") -> Callable[[str], float]:
    """A number from a range in which all results are finite."""

    def read(text: str) -> float:
        value = number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected a {kind} from {low:g} to {high:g}, not {text}")
        return value

    return read


positive = between(1e-300, 1e300)
not_negative = between(0.0, _LARGEST, "number")
seconds = between(1e-9, _LARGEST)
metres = between(1e-6, _LARGEST)


def count(text: str) -> int:
    """A positive whole number."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a positive whole number, not {text}")
    return int(text)


def seed(text: str) -> int:
    """A seed that JAX accepts."""
    value = whole(text)
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to 2^63 - 1, not {text}")
    return value


def exponent(text: str) -> float:
    """The exponent of ``--norm``: of the power mean over the three axes of a frame."""
    try:
        return check_exponent(number(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def scales(text: str) -> str | tuple[int, ...]:
    """The time scales: "auto", "mean", or numbers of samples such as "1" or "1,2,4"."""
    if text in ("auto", "mean"):
        return text
    try:
        return tuple(count(part.strip()) for part in text.split(","))
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(
            f"expected auto, mean, or powers of two such as 1 or 4,8,16, not {text!r}"
        ) from error


def assumed(text: str) -> str:
    """The name of a constraint that ``--assume`` accepts."""
    from reframe_jax.identification.naming import codes_of

    try:
        codes_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def label(text: str) -> str:
    """The letter of one of the twelve constraints of the paper, given as a letter or a name."""
    try:
        entry = constraint(text)
    except KeyError as error:
        raise argparse.ArgumentTypeError(error.args[0]) from error
    if entry.label not in CONSTRAINTS:
        raise argparse.ArgumentTypeError(f"expected a constraint from A to L, not {text!r}")
    return entry.label


def add_constraint(command: argparse.ArgumentParser) -> None:
    """The option ``--constraint``."""
    command.add_argument(
        "--constraint",
        type=label,
        required=True,
        metavar="K",
        help="letter or name; reframe-jax constraints lists them",
    )


def add_seed(command: argparse.ArgumentParser) -> None:
    """The option ``--seed``."""
    command.add_argument("--seed", type=seed, default=0, metavar="N", help="random seed (0)")
