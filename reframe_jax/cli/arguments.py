"""Options that several commands have, and the types of their arguments.

A type is a function that converts text, or raises an ArgumentTypeError. MuJoCo is imported when a command
runs.
"""

import argparse
import math
import os
from collections.abc import Callable
from typing import Any, TypeVar

import jax

from reframe_jax.compilation import OLD_EMITTERS
from reframe_jax.constraints.catalogue import CONSTRAINTS, constraint
from reframe_jax.objectives.norms import check_exponent
from reframe_jax.program_cache import cache_programs
from reframe_jax.storage.progress import make_meter

T = TypeVar("T")
_LARGEST = 1e6  # m or s: larger than any motion, with a finite square
_FAST_COMPILATION = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
_IMPERFECTIONS = {"none": None, "encoder": "ENCODER_GRADE", "realistic": "REALISTIC", "matched": "MATCHED"}


def _argument(read: Callable[[str], T]) -> Callable[[str], T]:
    """Convert a ValueError or KeyError to an ArgumentTypeError, whose message the user sees."""

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


@_argument
def exponent(text: str) -> float:
    """Convert text to the exponent of the power mean over the three axes of a frame."""
    return check_exponent(_number("number")(text))


def scales(text: str) -> str | tuple[int, ...]:
    """Convert text to time scales: "auto", "mean", or counts of samples such as "1" or "1,2,4"."""
    if text in ("auto", "mean"):
        return text
    try:
        return tuple(count(part.strip()) for part in text.split(","))
    except argparse.ArgumentTypeError as error:
        message = f"expected auto, mean, or powers of two such as 1 or 4,8,16, not {text!r}"
        raise argparse.ArgumentTypeError(message) from error


@_argument
def assumed(text: str) -> str:
    """Return the name of a constraint unchanged if ``--assume`` accepts it."""
    from reframe_jax.identification.naming import codes_of

    codes_of(text)
    return text


@_argument
def _letter(text: str) -> str:
    """Convert a letter, name or common word to the letter of one of the twelve constraints of the paper."""
    label = constraint(text).label
    if label not in CONSTRAINTS:
        raise ValueError(f"expected a constraint from A to L, not {text!r}")
    return label


def add_constraint(command: argparse.ArgumentParser, on_arm: bool = False) -> None:
    """Add the option ``--constraint``; an arm makes only the twelve constraints of the paper."""
    text = "letter from A to L, or name" if on_arm else "letter or name"
    kind = _letter if on_arm else _argument(lambda text: constraint(text).label)
    text += "; reframe-jax constraints lists them"
    command.add_argument("--constraint", type=kind, required=True, metavar="K", help=text)


def add_seed(command: argparse.ArgumentParser) -> None:
    """Add the option ``--seed``."""
    command.add_argument("--seed", type=_seed, default=0, metavar="N", help="random seed (0)")


def add_cache(command: argparse.ArgumentParser) -> None:
    """Add the option ``--no-cache`` to a command that compiles programs."""
    command.add_argument(
        "--no-cache",
        dest="cache",
        action="store_false",
        help="do not store compiled programs for later runs (REFRAME_JAX_CACHE=0 has the same effect); "
        "to delete stored programs, delete the folder reframe_jax in XDG_CACHE_HOME or ~/.cache",
    )


def configure_jax(cache: bool) -> None:
    """Enable 64-bit mode, and keep compiled programs between runs, unless ``REFRAME_JAX_CACHE=0``."""
    flags = os.environ.get("XLA_FLAGS", "")
    if not OLD_EMITTERS and "xla_backend_extra_options" not in flags:
        # the same option for all programs; the compiler reads it when it starts
        os.environ["XLA_FLAGS"] = f"{flags} {_FAST_COMPILATION}".strip()
    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]
    if cache and os.environ.get("REFRAME_JAX_CACHE") != "0":
        cache_programs()


def add_demonstrations(command: argparse.ArgumentParser) -> None:
    """Add the options that ``demonstrate`` and ``reproduce`` have in common to a command."""
    add = command.add_argument
    add_constraint(command, on_arm=True)
    add("--robot", choices=["panda", "fr3"], default="panda", help="robot arm; the paper uses fr3 (panda)")
    add(
        "--imperfections",
        choices=[*_IMPERFECTIONS],
        default="realistic" if command.prog.endswith("reproduce") else "encoder",
        help="errors of the poses: none, encoder noise, encoder noise and compliance, or the compliance of "
        "the paper's set-up (%(default)s)",
    )
    add(
        "--excitation",
        choices=["exciting", "brisk"],
        default="exciting",
        help="motion along the free axes: many frequencies; brisk turns hinges as fast as in the paper's "
        "Table 4 (exciting)",
    )
    add("--fixed", action="store_true", help="use one geometry for all demonstrations instead of random ones")
    add_seed(command)
    add_cache(command)


def prepare_demonstrations(options: argparse.Namespace) -> dict[str, Any]:
    """Configure JAX, and return the options of :func:`add_demonstrations` as arguments of a simulation."""
    configure_jax(options.cache)
    from reframe_jax.simulation import arm

    name = _IMPERFECTIONS[options.imperfections]
    return {
        "imperfections": arm.Imperfections() if name is None else getattr(arm, name),
        "excitation": options.excitation,
        "spread": (0.0, 0.0) if options.fixed else arm.SPREAD,
        "arm": options.robot,
        "progress": make_meter(None, "demonstrations"),
    }
