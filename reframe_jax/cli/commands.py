"""Names, examples and parser of all commands; this module does not import JAX."""

import argparse
import sys
from typing import Any, NoReturn

from reframe_jax.cli.printing import print_result

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
    "completion": "print a script that completes the command line in a shell",
}
EXAMPLES = """\
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


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line and refers to the help."""

    def error(self, message: str) -> NoReturn:
        """Print the error in one line and exit with code 2."""
        self.exit(2, f"{self.prog}: error: {message.rstrip('.')}; see {self.prog} --help\n")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Report an error if the help or the version cannot be written; argparse ignores this error."""
        if file is sys.stdout:
            print_result(message, end="")
        else:
            super()._print_message(message, file)


def add_command(
    commands: Any, name: str, run: Any, text: str, *, compiles: bool = True
) -> argparse.ArgumentParser:
    """Add a command to the parser, and return the parser of this command.

    Args:
        commands: result of ``add_subparsers``.
        name: name of the command.
        run: function of the parsed options that runs the command and returns the exit code.
        text: description for ``--help``.
        compiles: whether the command compiles programs; it then has the option ``--no-cache``.
    """
    examples = [line for line in EXAMPLES.splitlines() if f"reframe-jax {name} " in line]
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        description=text,
        help=COMMANDS[name],
        epilog="\n".join(["example:" if len(examples) == 1 else "examples:", *examples])
        if examples
        else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if compiles:
        command.add_argument(
            "--no-cache",
            dest="cache",
            action="store_false",
            help="do not store compiled programs for later runs (REFRAME_JAX_CACHE=0 has the same effect); "
            "to delete stored programs, delete the folder reframe_jax in XDG_CACHE_HOME or ~/.cache",
        )
    command.set_defaults(run=run, usage_error=command.error)
    return command
