"""Output of the command line: results to standard output, everything else to standard error."""

import contextlib
import os
import sys

__all__ = ["print_error", "print_result"]


def print_error(text: str, end: str = "\n") -> None:
    """Print a line to standard error at once; drop it if standard error is closed."""
    with contextlib.suppress(OSError):
        print(text, end=end, file=sys.stderr, flush=True)


def print_result(text: str, end: str = "\n") -> None:
    """Print results to standard output at once.

    Raises:
        SystemExit: with code 1 if they cannot be written, silently if nobody reads the pipe any more.
    """
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        with contextlib.suppress(OSError, ValueError):  # what is left in the buffer would be tried again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            print_error(f"reframe-jax: error: standard output cannot be written: {error.strerror}.")
        raise SystemExit(1) from error
