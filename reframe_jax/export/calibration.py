"""Write a calibration as a table for people, or as JSON for programs.

``docs/exports.md`` describes the JSON document.
"""

from typing import Any

import numpy as np

from reframe_jax.calibration.tool import Calibration
from reframe_jax.export.common import plain
from reframe_jax.joints.joint import format_vector
from reframe_jax.recordings.recording import Recording, name_rows

SCHEMA = "reframe-jax/calibration/1"

_FIELDS = (
    *("tip", "tip_interval", "point", "point_interval", "axis", "ground_axis", "axis_interval"),
    *("rms", "turned", "weakest", "residuals", "axis_residuals"),
)
_LISTED = 40  # largest number of residuals in a table; of more, only the largest are listed
_WEAK = 0.09  # rad RMS, 5 degrees: below this tilt, the table recommends to tilt more


def calibration_to_table(found: Calibration, recording: Recording) -> str:
    """Format a calibration as text: the tip or the axis, error bars, and the residual of every row."""
    numbers, row_word = _row_numbers(found, recording), recording.row_word
    lines = [f"{recording.path}: {'Pivot' if found.axis is None else 'Spin'} calibration"]
    out = numbers[~found.used]
    lines.append(f"{int(found.used.sum())} of {len(found.used)} poses used. Error bars are 95 % intervals.")
    if len(out):
        verb = "does" if len(out) == 1 else "do"
        lines.append(f"Outlying, and left out: {name_rows(row_word, out)} {verb} not fit the other rows.")
    lines.append("")
    if found.axis is not None and found.ground_axis is not None and found.axis_interval is not None:
        error = np.degrees(found.axis_interval)
        lines.append(f"Axis      {format_vector(found.axis, 5)} in the body, ± {error:.2g} deg")
        lines.append(f"          {format_vector(found.ground_axis, 5)} in the ground")
    for title, where, place, interval in (
        ("Tip  " if found.axis is None else "Place", "body", found.tip, found.tip_interval),
        ("Point", "ground", found.point, found.point_interval),
    ):
        widths = ", ".join(f"{1e3 * width:.2g}" for width in interval)
        lines.append(f"{title}     {format_vector(place, 5)} m in the {where}, ± ({widths}) mm")
    if found.axis is not None:
        lines.append("          Any point on this axis is equally valid.")
    lines.append(f"Residual  {1e3 * found.rms:.2g} mm RMS")
    if found.axis is None:
        sentence = f"{np.degrees(found.turned):.2g} deg RMS in the direction of the least tilt"
        if found.turned < _WEAK:
            direction = format_vector(found.weakest, 3)
            sentence += f". Tilt farther: the tip is uncertain along {direction} in the body"
        lines.append(f"Tilt      {sentence}")
    else:
        lines.append(f"Turn      {np.degrees(found.turned):.2g} deg RMS about the axis")
    many = len(numbers) > _LISTED
    lines += ["", f"Residuals, the {_LISTED} largest" if many else "Residuals"]
    for row in np.argsort(-found.residuals, kind="stable")[:_LISTED] if many else range(len(numbers)):
        angles = found.axis_residuals
        angle = "" if angles is None else f"  {np.degrees(angles[row]):8.2f} deg"
        mark = "" if found.used[row] else "  left out"
        lines.append(f"  {row_word} {numbers[row]:<6} {1e3 * found.residuals[row]:8.2f} mm{angle}{mark}")
    return "\n".join(lines)


def _row_numbers(found: Calibration, recording: Recording) -> np.ndarray:
    return np.arange(len(found.used)) if recording.rows is None else recording.rows


def calibration_to_record(found: Calibration, recording: Recording) -> dict[str, Any]:
    """Convert a calibration to "calibration" in the JSON document, in plain Python types."""
    arrays = {name: getattr(found, name) for name in _FIELDS}
    rows = _row_numbers(found, recording)
    named = {"kind": "pivot" if found.axis is None else "spin", "row_word": recording.row_word}
    return plain(named | arrays | {"rows": rows, "outliers": rows[~found.used]})
