"""Write a segmentation as a table for people, or as JSON for programs.

``docs/exports.md`` describes the JSON document.
"""

from dataclasses import asdict
from typing import Any

from reframe_jax.export.common import Window
from reframe_jax.export.json import to_record
from reframe_jax.segmentation.results import Segmentation

SCHEMA = "reframe-jax/segmentation/2"


def segments_to_table(found: Segmentation, *, label: str) -> str:
    """Format a segmentation as text, one row per segment."""
    rows = [f"{label}: {len(found)} segment{'' if len(found) == 1 else 's'}"]
    rows.append(f"{'from':>9} {'to':>9}  {'label':>5}  constraint")
    for segment, boundary in zip(found.segments, [None, *found.boundaries], strict=True):
        start, stop = (float(found.times[i]) for i in (segment.start, segment.stop - 1))
        label_text = "" if segment.resting else str(segment.label)
        row = f"{start:>7.3f} s {stop:>7.3f} s  {label_text:>5}  {segment.name}"
        if segment.identification is not None:
            row += f" ({100 * segment.identification.probability:.0f} %)"
        if boundary is not None:
            low, high = (float(found.times[i]) for i in (boundary.earliest, boundary.latest))
            row += f"; since {low:.3f} to {high:.3f} s ({100 * boundary.probability:.0f} %)"
        rows.append(row)
    return "\n".join(rows)


def segments_to_record(found: Segmentation | None, *, label: str, error: str | None) -> dict[str, Any]:
    """Convert a segmentation, or None if it failed, to an entry of the JSON document."""
    record: dict[str, Any] = {"recording": label, "error": error}
    record |= {"motion_time": None, "segments": [], "boundaries": []}
    if found is None:
        return record
    segments = []
    for segment in found.segments:
        start, stop = (float(found.times[i]) for i in (segment.start, segment.stop - 1))
        window = Window(segment.start, segment.stop, start, stop)
        named: dict[str, Any] = {"label": segment.label, "name": segment.name, "identification": None}
        if segment.identification is not None:
            (named["identification"],) = to_record(segment.identification, windows=[window])["windows"]
        segments.append(asdict(window) | named)
    return record | {
        "motion_time": found.motion_time,
        "segments": segments,
        "boundaries": [asdict(boundary) for boundary in found.boundaries],
    }
