"""The table that summarizes several recordings."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

_COLUMNS = ("recording", "windows", "name", "prob.", "angular", "linear", "origin [m]", "noise", "status")


def summary_table(records: Sequence[dict[str, Any]]) -> str:
    """Format one row per record of :func:`.to_record`; for several windows, with the most frequent name."""
    rows = [list(_COLUMNS), *(_row(record) for record in records)]
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _row(record: dict[str, Any]) -> list[str]:
    every = record["windows"]
    windows = [window for window in every if window.get("name") is not None]
    start = [str(record["recording"]), str(len(every))]
    if not windows:
        return [*start, *("-",) * 6, "error" if record["error"] else every[0]["status"]]
    if len(every) > 1:
        (name, number) = Counter(window["name"] for window in windows).most_common(1)[0]
        statuses = Counter(window["status"] for window in every).most_common()
        status_counts = ", ".join(f"{count} {status}" for status, count in statuses)
        return [*start, f"{name} ({number} of {len(every)})", *("-",) * 5, status_counts]
    (window,) = windows
    noise = window["noise"]
    return [
        *(*start, window["name"], f"{window['probability']:.2f}"),
        *(window["angular"]["type"], window["linear"]["type"]),
        ", ".join(f"{value + 0.0:.3f}" for value in np.round(window["linear"]["position"], 3)),
        f"{1e3 * noise['position']:.2g} mm, {np.degrees(noise['rotation']):.2g} deg",
        window["status"],
    ]
