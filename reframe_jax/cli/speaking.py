"""What the command line says beside its results: notes, progress and errors, on standard error."""

import sys

__all__ = ["say"]


def say(text: str, end: str = "\n") -> None:
    """Print a line to standard error at once."""
    print(text, end=end, file=sys.stderr, flush=True)
