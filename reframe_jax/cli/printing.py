"""Output of the command line: results to standard output, other messages to standard error."""

import contextlib
import os
import sys


def print_error(text: str, end: str = "\n") -> None:
    """Print a line to standard error and flush it; ignore a closed standard error."""
    with contextlib.suppress(OSError):
        print(text, end=end, file=sys.stderr, flush=True)


def fail(problem: object) -> int:
    """Print an error in one line, and return the exit code 1."""
    print_error(f"reframe-jax: error: {problem}")
    return 1


def print_result(text: str, end: str = "\n") -> None:
    """Print results to standard output and flush them; exit with code 1 if that fails."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        with contextlib.suppress(OSError, ValueError):  # otherwise Python writes the buffer again on exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            fail(f"standard output cannot be written: {error.strerror}.")
        raise SystemExit(1) from error
