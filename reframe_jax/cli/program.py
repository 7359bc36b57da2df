"""The command line: its commands, options and exit codes.

Results go to standard output; notes on the input, progress and errors go to standard error. The exit
code is 0 on success, 1 if a file failed, and 2 for a wrong command line. All computations use 64 bits.
This module does not import JAX.
"""

import argparse
import importlib
import io
import signal
import sys
from collections.abc import Collection, Sequence
from typing import Any, NoReturn

import reframe_jax
from reframe_jax.cli.printing import fail, print_result

COMMANDS = {
    "identify": "identify the constraint in recordings",
    "calibrate": "find the tip or the axis of a tool from separate poses",
    "topics": "list the topics, bodies and columns in files",
    "segment": "find the times at which the constraint of a recording changes",
    "simulate": "simulate a recording",
    "demonstrate": "simulate demonstrations on a robot arm",
    "reproduce": "demonstrate, identify and reproduce a task",
    "view": "show a recording and its constraint in the browser",
    "constraints": "list the named constraints",
}
"""Commands: each is a module of this package with a docstring for ``--help``, ``add_options`` and ``run``."""

_DESCRIPTION = """\
Identify the constraint of a measured motion: the body in which the constraint
frame is fixed, the location of the frame, and its free and constrained axes.
"""
_EXAMPLES = """\
examples:
  reframe-jax simulate --constraint A --noise 1e-4 --out door.csv
  reframe-jax identify door.csv --plot door.png
  reframe-jax identify *.csv --window 50 --stride 10 --json answers.json
  reframe-jax calibrate touches.csv
  reframe-jax calibrate turns.csv --spin
  reframe-jax topics walk.mcap
  reframe-jax segment kitchen.csv --plot kitchen.png
  reframe-jax view door.csv --html door.html
  reframe-jax identify walk.mcap --from map --to tool
  reframe-jax identify door.csv --urdf door.urdf --parent frame --child door
"""


class _Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line and refers to the help."""

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **options)

    def error(self, message: str) -> NoReturn:
        """Print the error in one line and exit with code 2."""
        self.exit(2, f"{self.prog}: error: {message.rstrip('.')}; see {self.prog} --help\n")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Report an error if the help or the version cannot be written; argparse ignores this error."""
        if file is sys.stdout:
            print_result(message, end="")
        else:
            super()._print_message(message, file)


def run_process() -> int:
    """Run the command line with the arguments of the process, and return the exit code."""
    # Python's handler of Ctrl-C waits for the compiler; background jobs continue to ignore the signal
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.stdout is None:
        return fail("standard output is closed.")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names can contain any byte
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, by default those of the process; return the exit code.

    ``--help``, ``--version``, a wrong command line, and a standard output that cannot be written exit.
    """
    argv = sys.argv[1:] if argv is None else argv
    options, rest = build_parser(argv).parse_known_args(argv)
    if rest:
        options.usage_error(f"unrecognized arguments: {' '.join(rest)}")
    from reframe_jax.recordings.recording import RecordingError

    try:
        return options.run(options)
    except RecordingError as error:
        return fail(error)
    except KeyboardInterrupt:
        return 130  # exit code that shells report for Ctrl-C


def build_parser(words: Collection[str]) -> argparse.ArgumentParser:
    """Build the parser and import the commands that are among the words, because an import takes a second.

    The other commands have a name but no options.
    """
    parser = _Parser(prog="reframe-jax", description=_DESCRIPTION, epilog=_EXAMPLES)
    parser.add_argument("--version", action="version", version=f"%(prog)s {reframe_jax.__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        if name not in words:
            commands.add_parser(name, help=text)
            continue
        module = importlib.import_module(f"reframe_jax.cli.{name}")
        examples = [line for line in _EXAMPLES.splitlines() if f"reframe-jax {name} " in line]
        heading = [f"example{'' if len(examples) == 1 else 's'}:"] if examples else []
        epilog = "\n".join([*heading, *examples])
        command = commands.add_parser(name, help=text, description=module.__doc__, epilog=epilog)
        command.set_defaults(run=module.run, usage_error=command.error)
        module.add_options(command)
    return parser
