"""The command line: identify recordings, simulate some, list the catalogue.

Results go to standard output; notes about the input, progress and errors to standard error. The exit
code is 0 if everything went well, 1 if a file failed, and 2 for a wrong command line. Everything is
computed in 64 bits.
"""

import argparse
from collections.abc import Sequence

import reframe_jax
from reframe_jax.cli import arguments
from reframe_jax.cli.commands import EXAMPLES
from reframe_jax.cli.constraints import add_constraints
from reframe_jax.cli.demonstrate import add_demonstrate
from reframe_jax.cli.identify import add_identify
from reframe_jax.cli.reproduce import add_reproduce
from reframe_jax.cli.simulate import add_simulate

__all__ = ["main"]

_DESCRIPTION = """\
Find the frame in which a measured motion is constrained: the body it is
attached to, where it lies, and along which axes it cannot move.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Args:
        argv: arguments, by default those of the process.

    Raises:
        SystemExit: with code 2 for a wrong command line, 0 after ``--help`` and ``--version``.
    """
    options = _parser().parse_args(argv)
    try:
        code: int = options.run(options)
    except KeyboardInterrupt:
        return 130  # as shells report it
    return code


def _parser() -> argparse.ArgumentParser:
    parser = arguments.Parser(
        prog="reframe-jax",
        description=_DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {reframe_jax.__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in (add_identify, add_simulate, add_demonstrate, add_reproduce, add_constraints):
        add(commands)
    return parser
