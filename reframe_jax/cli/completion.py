"""Print a script that completes the command line in a shell.

For bash:  reframe-jax completion bash > ~/.local/share/bash-completion/completions/reframe-jax
For zsh:   reframe-jax completion zsh > a file _reframe-jax in a folder of $fpath
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

from reframe_jax.cli.printing import fail, print_result


def add_options(command: argparse.ArgumentParser) -> None:
    """Add the name of the shell."""
    command.add_argument("shell", choices=["bash", "zsh", "tcsh"], help="shell to complete in")


def run(options: argparse.Namespace) -> int:
    """Print the script."""
    try:
        import shtab
    except ImportError:
        return fail("completion needs shtab: pip install 'reframe-jax[completion]'")
    from reframe_jax.cli.program import build_parser

    parser = build_parser()
    for action in _actions(parser):
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    print_result(shtab.complete(parser, options.shell), end="")
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield all arguments of a parser and of its subcommands."""
    for action in parser._actions:
        yield action
        if isinstance(action.choices, dict):
            for command in action.choices.values():
                yield from _actions(command)
