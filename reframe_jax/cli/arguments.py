"""Types of command-line arguments: functions that convert text, or raise an ArgumentTypeError."""

import argparse
import math
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from reframe_jax.constraints.catalogue import CONSTRAINTS, constraint
from reframe_jax.objectives.norms import check_exponent

T = TypeVar("T")
_LARGEST = 1e6  # m or s: larger than any motion, with a finite square


def _argument(read: Callable[[str], T]) -> Callable[[str], T]:
    """Convert a ValueError or KeyError to an ArgumentTypeError, whose message the user sees."""

    @wraps(read)
    def checked(text: str) -> T:
        try:
            return read(text)
        except (ValueError, KeyError) as error:
            raise argparse.ArgumentTypeError(error.args[0]) from error

    return checked


def _number(kind: str, low: float = -math.inf, high: float = math.inf, convert: Any = float) -> Any:
    """Return a function that converts text to a number from ``low`` to ``high``."""

    @_argument
    def read(text: str) -> Any:
        try:
            value = convert(text)
        except ValueError as error:
            raise ValueError(f"expected a {kind}, not {text!r}") from error
        if not low <= value <= high:
            raise ValueError(f"expected a {kind} from {low:g} to {high:g}, not {text}")
        return value

    return read


positive = _number("positive number", 1e-300, 1e300)
not_negative = _number("number", 0, _LARGEST)
seconds = _number("positive number", 1e-9, _LARGEST)
metres = _number("positive number", 1e-6, _LARGEST)
whole = _number("whole number", convert=int)
count = _number("positive whole number", 1, convert=int)
_seed = _number("whole number", 0, 2**63 - 1, int)
_any_number = _number("number")


@_argument
def exponent(text: str) -> float:
    """Convert text to the exponent of the power mean over the three axes of a frame."""
    return check_exponent(_any_number(text))


@_argument
def scales(text: str) -> str | tuple[int, ...]:
    """Convert text to time scales: "auto", "mean", or counts of samples such as "1" or "1,2,4"."""
    if text in ("auto", "mean"):
        return text
    try:
        return tuple(count(part.strip()) for part in text.split(","))
    except argparse.ArgumentTypeError as error:
        message = f"expected auto, mean, or powers of two such as 1 or 4,8,16, not {text!r}"
        raise ValueError(message) from error


@_argument
def assumed(text: str) -> str:
    """Return the name of a constraint unchanged if ``--assume`` accepts it."""
    from reframe_jax.identification.naming import codes_of

    codes_of(text)
    return text


@_argument
def _label(text: str) -> str:
    """Convert a letter or name to the letter of one of the twelve constraints of the paper."""
    entry = constraint(text)
    if entry.label not in CONSTRAINTS:
        raise ValueError(f"expected a constraint from A to L, not {text!r}")
    return entry.label


def add_constraint(command: argparse.ArgumentParser) -> None:
    """Add the option ``--constraint``."""
    text = "letter or name; reframe-jax constraints lists them"
    command.add_argument("--constraint", type=_label, required=True, metavar="K", help=text)


def add_seed(command: argparse.ArgumentParser) -> None:
    """Add the option ``--seed``."""
    command.add_argument("--seed", type=_seed, default=0, metavar="N", help="random seed (0)")
