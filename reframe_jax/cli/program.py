"""The command line: identify and simulate recordings, list the catalogue.

Results go to standard output; notes about the input, progress and errors to standard error. The exit
code is 0 on success, 1 if a file failed, and 2 for a wrong command line. All computations use 64 bits.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence, Set

import reframe_jax
from reframe_jax.cli.commands import COMMANDS, EXAMPLES, Parser

__all__ = ["full_parser", "main"]

_DESCRIPTION = """\
Find the frame in which a measured motion is constrained: the body it is
attached to, its location, and the axes along which it cannot move.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Args:
        argv: arguments, by default those of the process.

    Raises:
        SystemExit: with code 2 for a wrong command line, 1 if standard output cannot be written, 0 after
            ``--help`` and ``--version``.
    """
    argv = sys.argv[1:] if argv is None else argv
    options = _parser(argv).parse_args(argv)
    try:
        code: int = options.run(options)
    except KeyboardInterrupt:
        return 130  # as shells report it
    return code


def full_parser() -> argparse.ArgumentParser:
    """The parser with all commands, every one of them imported."""
    return _build(COMMANDS.keys())


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """The parser for these arguments: only the command they name is imported, which takes a second."""
    named = next((word for word in argv if not word.startswith("-")), None)
    return _build(COMMANDS.keys() & {named})


def _build(imported: Set[str]) -> argparse.ArgumentParser:
    """The parser; of commands that are not imported it knows the names only."""
    parser = Parser(
        prog="reframe-jax",
        description=_DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {reframe_jax.__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, help in COMMANDS.items():
        if name in imported:
            module = importlib.import_module(f"reframe_jax.cli.{name}")
            getattr(module, f"add_{name}")(commands)
        else:
            commands.add_parser(name, help=help)
    return parser
