"""Output of the command line: results to standard output, other messages to standard error."""

import contextlib
import os
import sys

__all__ = ["print_error", "print_result"]


def print_error(text: str, end: str = "\n") -> None:
    """Print a line to standard error and flush it; ignore a closed standard error."""
    with contextlib.suppress(OSError):
        print(text, end=end, file=sys.stderr, flush=True)


def print_result(text: str, end: str = "\n") -> None:
    """Print results to standard output and flush them; exit with code 1 if that fails."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        with contextlib.suppress(
            OSError, ValueError
        ):  # otherwise Python tries to write the buffer again on exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            print_error(f"reframe-jax: error: standard output cannot be written: {error.strerror}.")
        raise SystemExit(1) from error
