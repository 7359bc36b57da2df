"""Write an identification as JSON, for programs; ``docs/exports.md`` describes the document."""

import json
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import jax
import numpy as np

from reframe_jax.export import common
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.naming import constraint_of, name_of
from reframe_jax.identification.results import Identification
from reframe_jax.model.table import ENTRIES
from reframe_jax.recordings.recording import Recording

_RESULT = (
    *("name", "label", "probability", "alternatives", "pitch", "universal_axes", "noise", "scale"),
    *("outliers", "angular", "linear", "candidates"),
)
_LEAST = 0.01  # smallest probability of an alternative in the document

SCHEMA = "reframe-jax/identification/3"


def to_json(
    found: Identification, *, label: str | None = None, windows: Sequence[common.Window] | None = None
) -> str:
    """Write a JSON document of one recording, see the page Exports; arguments as in :func:`to_table`."""
    return to_document([to_record(found, label=label, windows=windows)])


def to_document(records: Sequence[dict[str, Any]], schema: str = SCHEMA) -> str:
    """Write a JSON document of several recordings from their entries, such as those of :func:`to_record`."""
    return json.dumps({"schema": schema, "recordings": list(records)}, indent=2, allow_nan=False)


def to_record(
    found: Identification | None,
    *,
    label: str | None = None,
    windows: Sequence[common.Window] | None = None,
    recording: Recording | None = None,
    error: str | None = None,
) -> dict[str, Any]:
    """Convert an identification of one window or a batch to an entry of "recordings" in the JSON document.

    ``found`` is None for a recording that could not be used because of an ``error``. The ``recording`` has
    notes and rows that were left out; other arguments as in :func:`to_table`.
    """
    each = [] if found is None else common.split_windows(jax.device_get(found))
    spans: Sequence[common.Window | None] = windows or [None] * len(each)
    records = (_window_record(*pair) for pair in zip(each, spans, strict=True))
    rows = None
    if recording is not None:
        used, unused = common.count_rows(recording, each)
        left_out = [{"reason": some.reason, "why": some.why, "rows": some.rows.tolist()} for some in unused]
        rows = {"word": recording.row_word, "used": used, "left_out": left_out}
    return {
        "recording": label,
        "error": error,
        "notes": [] if recording is None else list(recording.notes),
        "rows": rows,
        "windows": [{"index": index, **common.plain(record)} for index, record in enumerate(records)],
    }


def _window_record(found: Identification, span: common.Window | None) -> dict[str, Any]:
    record: dict[str, Any] = {name: getattr(span, name, None) for name in common.Window.__dataclass_fields__}
    record |= {"status": found.status.name, "message": found.status.message}
    if found.status.failed:
        return record | {"notes": []} | dict.fromkeys(_RESULT)
    entry, (ground, body) = found.entry, found.universal_axes
    probability = np.nan_to_num(np.asarray(found.entry_probability, float))
    record |= {
        "notes": found.warnings,
        "name": found.name,
        "label": entry.label if entry else None,
        "probability": found.probability,
        "alternatives": [
            {
                "name": name_of(code),
                "label": other.label if (other := constraint_of(code)) else None,
                "type": str(ENTRIES[code].kind),
                "probability": probability[code],
            }
            for code in np.argsort(-probability).tolist()
            if probability[code] > _LEAST
        ],
        "pitch": found.pitch,
        "universal_axes": {"ground": ground, "body": body} if np.isfinite([ground, body]).all() else None,
        "noise": {"position": found.noise.position, "rotation": found.noise.rotation},
        "scale": found.scale,
        "outliers": common.outlier_samples(found, span),
    }
    candidates: dict[str, Any] = {}
    for group, types in common.TYPES.items():
        frame, rest = getattr(found, group), getattr(found.candidates, group)
        named = {"type": str(frame.frame_type), "tied": common.tied_names(group, frame)}
        more = {name: getattr(frame, name) for name in ("free_probability", "amplitude", "free_rotation")}
        record[group] = named | _frame_record(frame) | more
        candidates[group] = {str(kind): _frame_record(jax.tree.map(itemgetter(kind), rest)) for kind in types}
    record["linear"]["free_position"] = common.directions(np.asarray(found.linear.free_position))
    return record | {"candidates": candidates}


def _frame_record(frame: Any) -> dict[str, Any]:
    """Geometry of an angular or linear frame, or of a candidate."""
    numbers = {"rotvec": frame.rotvec, "axes": np.asarray(rotation_exp(frame.rotvec)).T}
    numbers |= {name: getattr(frame, name, None) for name in ("dof", "rms", "norm", "position")}
    return {name: value for name, value in numbers.items() if value is not None}
