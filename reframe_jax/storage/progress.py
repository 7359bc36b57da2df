"""Progress of long runs."""

import sys
import time
from collections.abc import Callable

__all__ = ["Progress", "make_meter"]

Progress = Callable[[int, int | None], None]
"""Called with how many are done, and how many there are in all (None if unknown)."""

_BAR = 20  # characters


def make_meter(progress: Progress | bool | None, unit: str) -> Progress:
    """Return a function to call after every part.

    Args:
        progress: a function, used unchanged; True for a bar on standard error, False for none; None for a bar
            if standard error is a terminal.
        unit: what is counted, in the plural.
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
            filled = _BAR * done // total
            bar = "#" * filled + "-" * (_BAR - filled)
            left = f", {(total - done) / rate:.0f} s left" if rate else ""
            line = f"[{bar}] {done} of {total} {unit}, {rate:.0f}/s{left}"
        print(f"\r{line}  ", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return print_progress
