"""Run the Python cells of a page and write their output: ``python docs/cells.py docs/tutorial.md``.

A cell is a block marked ``python``. If the cell prints, the next block, marked ``text``, contains the output.
The tests run the cells and compare the output with the stored output (`tests/test_documentation.py`).
"""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
_CELL = re.compile(r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")


def run_cells(text: str, name: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Run the cells of a page in order.

    Args:
        text: text of the page.
        name: name of the page, for tracebacks.

    Returns:
        The names that the cells define, and the stored and the new output of every cell.
    """
    names: dict[str, Any] = {"__name__": name}
    outputs = []
    with np.printoptions(precision=4, suppress=True, floatmode="maxprec_equal"):
        for code, stored in _CELL.findall(text):
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(code, name, "exec"), names)
            outputs.append((stored, _strip_lines(printed.getvalue())))
    return names, outputs


def stored_outputs(text: str) -> list[str]:
    """Output that a page stores for each of its cells; empty for a cell without output."""
    return [stored for _, stored in _CELL.findall(text)]


def _strip_lines(text: str) -> str:
    """Remove blanks at the ends of lines, and empty lines at the end."""
    lines = "\n".join(line.rstrip() for line in text.splitlines()).rstrip()
    return f"{lines}\n" if lines else ""


def output_differences(stored: str, printed: str) -> list[str]:
    """Lines that differ: words must be equal, numbers within 5 % or two units of the last printed digit."""
    old, new = stored.splitlines(), printed.splitlines()
    if len(old) != len(new):
        return [f"{len(old)} lines are stored, and {len(new)} are printed:", printed]
    return [f"{a!r} is stored, {b!r} is printed" for a, b in zip(old, new, strict=True) if not _agree(a, b)]


def _agree(stored: str, printed: str) -> bool:
    words = [
        "".join(_NUMBER.sub("#", line).split()) for line in (stored, printed)
    ]  # a sign changes the number of blanks
    if words[0] != words[1]:
        return False
    return all(_near(a, b) for a, b in zip(_numbers(stored), _numbers(printed), strict=True))


def _numbers(line: str) -> Iterator[str]:
    return (match[0] for match in _NUMBER.finditer(line))


def _near(stored: str, printed: str) -> bool:
    digits = len(stored.partition("e")[0].partition(".")[2])
    exponent = int(stored.partition("e")[2] or 0)
    last = 10.0 ** (exponent - digits)
    return abs(float(stored) - float(printed)) <= 0.05 * abs(float(stored)) + 2 * last


def write_outputs(page: Path) -> None:
    """Replace the stored outputs of a page by the current output of its cells."""
    text = page.read_text()
    outputs = iter(printed for _, printed in run_cells(text, page.name)[1])

    def replace(match: re.Match[str]) -> str:
        printed = next(outputs)
        return f"```python\n{match[1]}```\n" + (f"\n```text\n{printed}```\n" if printed else "")

    page.write_text(_CELL.sub(replace, text))


if __name__ == "__main__":
    os.chdir(ROOT)
    for argument in sys.argv[1:]:
        write_outputs(Path(argument))
