"""Show the progress of long runs."""

import sys
import time
from collections.abc import Callable

Progress = Callable[[int, int | None], None]
"""Function of the number of completed items and the total number (None if unknown)."""

_BAR = 20  # width in characters


def make_meter(progress: Progress | bool | None, unit: str) -> Progress:
    """Return a progress function to call after every part: the given one, or a bar on standard error.

    False shows nothing; None shows the bar if standard error is a terminal. ``unit`` is the word for the
    counted items, in the plural.
    """
    if callable(progress):
        return progress
    if progress is False or (progress is None and not sys.stderr.isatty()):
        return lambda done, total: None
    begin = time.perf_counter()

    def print_progress(done: int, total: int | None) -> None:
        rate = done / (time.perf_counter() - begin)
        line = f"{done} {unit}, {rate:.0f}/s"
        if total:
            bar = ("#" * (_BAR * done // total)).ljust(_BAR, "-")
            left = f", {(total - done) / rate:.0f} s left" if rate else ""
            line = f"[{bar}] {done} of {total} {unit}, {rate:.0f}/s{left}"
        print(f"\r{line}  ", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return print_progress
