"""The command line: its commands, options and exit codes.

Results go to standard output; notes on the input, progress and errors go to standard error. The exit
code is 0 on success, 1 if a file failed, and 2 for a wrong command line. All computations use 64 bits.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence, Set

import reframe_jax
from reframe_jax.cli.commands import COMMANDS, EXAMPLES, Parser

_DESCRIPTION = """\
Identify the constraint of a measured motion: the body in which the constraint
frame is fixed, the location of the frame, and its free and constrained axes.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, by default those of the process; return the exit code.

    Raises:
        SystemExit: with code 2 for a wrong command line, 1 if standard output cannot be written, 0 after
            ``--help`` and ``--version``.
    """
    argv = sys.argv[1:] if argv is None else argv
    options, rest = _parser(argv).parse_known_args(argv)
    if rest:
        options.usage_error(f"unrecognized arguments: {' '.join(rest)}")
    try:
        code: int = options.run(options)
    except KeyboardInterrupt:
        return 130  # exit code that shells report for Ctrl-C
    return code


def full_parser() -> argparse.ArgumentParser:
    """Build the parser and import all commands."""
    return _build(COMMANDS.keys())


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    """Build the parser and import only the command in the arguments, because an import takes a second."""
    named = next((word for word in argv if not word.startswith("-")), None)
    return _build(COMMANDS.keys() & {named})


def _build(imported: Set[str]) -> argparse.ArgumentParser:
    """Build the parser; commands that are not imported have a name but no options."""
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
