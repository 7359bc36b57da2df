"""What all commands have in common."""

import argparse
from typing import Any

__all__ = ["EXAMPLES", "add_command"]

EXAMPLES = """\
examples:
  reframe-jax simulate --constraint A --noise 1e-4 --out door.csv
  reframe-jax identify door.csv --plot door.png
  reframe-jax identify *.csv --window 50 --stride 10 --json answers.json
"""


def add_command(commands: Any, name: str, run: Any, text: str, help: str) -> argparse.ArgumentParser:
    """Add a command, and the option that all commands have; ``run`` gets the options."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        description=text,
        help=help,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_argument(
        "--no-cache",
        dest="cache",
        action="store_false",
        help="do not keep compiled programs for later runs (in XDG_CACHE_HOME or ~/.cache)",
    )
    command.set_defaults(run=run, usage_error=command.error)
    return command
