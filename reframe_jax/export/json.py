"""An identification as JSON, for programs.

The document that ``to_json`` and ``reframe-jax identify --json`` write has the schema named by
:data:`SCHEMA`. Numbers are in SI units (m, rad, s, m/s, rad/s); NaN and infinities are written as null::

    {
      "schema": "reframe-jax/identification/2",
      "recordings": [
        {
          "recording": the label, or null,
          "error":     why the recording could not be used; else null,
          "notes":     sentences about repaired or odd input,
          "windows": [
            {
              "index": position in the batch, counted through all of its axes,
              "start", "stop": samples of the recording, from start up to but not including stop, or null,
              "start_time", "stop_time": s, of the first and the last sample, or null,
              "status": name of a ``Status``, "message": its sentence,
              "notes": reasons to doubt the result, ``warnings`` of the window,
              "name": of the constraint, "label": letter or word in the catalogue, or null outside of it,
              "probability": of the name; see ``Identification.probability`` for what it is conditional on,
              "class_probability": [
                {"type": of the linear frame, "rotations", "translations": how many are free, "probability"},
                those above 0.01, the likeliest first
              ],
              "screw_probability": of a screw joint, where one rotation and a translation along it are free,
              "pitch": m/rad of a screw joint, positive for a right-handed thread, else null,
              "universal_probability": of a universal joint, where the body turns about a point,
              "universal_axes": {"ground": [3], "body": [3]; unit vectors} of a universal joint, else null,
              "noise": {"position": m, "rotation": rad; standard deviations of every component},
              "lag": samples between the two poses of a velocity,
              "refined": whether the frames are those of the displacements between all pairs of poses,
              "outliers": samples of the recording that took no part; counted from the first pose of the
                window where "start" is null,
              "angular": {
                "type": "G" or "B", "tied": types that explain the motion as well, this one included,
                "rotvec": [3], "axes": [3 unit vectors], "dof": [3, 1 is free],
                "free_probability": [3], "rms": [3], "norm": number,
                "free_rotation": [3 booleans, axes about which the frame can be turned],
              },
              "linear": {
                the same with "type" and "tied" of "BB", "GB", "GG", "BG", and
                "position": [3], "free_position": [unit vectors along which the position is undetermined],
                "coupled_position": [unit vectors along which it can move if the axes turn along],
                "twin": [3] another position that explains the window as well, or null,
              },
              "candidates": {
                "angular": {type: as "angular", without "type", "tied" and "free_probability"},
                "linear": {type: as "linear", without them, "coupled_position" and "twin", and "on_bounds",
                  "agreement"},
              }
            }
          ]
        }
      ]
    }

Windows without a result have null for all that comes after "message", and no "notes".
Orientations are given in the body of the type's first letter (G ground, B body), positions in that of
the last.
"""

import json
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.export.common import (
    TYPES,
    Window,
    axes_of,
    directions,
    outlier_samples,
    split_windows,
    tied_names,
)
from reframe_jax.identification.results import Identification
from reframe_jax.motion.checks import Status

__all__ = ["SCHEMA", "to_document", "to_json", "to_record"]

_RESULT = (
    "name",
    "label",
    "probability",
    "class_probability",
    "screw_probability",
    "pitch",
    "universal_probability",
    "universal_axes",
    "noise",
    "lag",
    "refined",
    "outliers",
    "angular",
    "linear",
    "candidates",
)

_LEAST = 0.01  # probability of a class that is written

SCHEMA = "reframe-jax/identification/2"


def to_json(
    found: Identification, *, label: str | None = None, windows: Sequence[Window] | None = None
) -> str:
    """A JSON document of one recording; arguments as in :func:`to_table`, schema in the module's text."""
    return to_document([to_record(found, label=label, windows=windows)])


def to_document(records: Sequence[dict[str, Any]]) -> str:
    """A JSON document of several recordings, each made by :func:`to_record`."""
    return json.dumps({"schema": SCHEMA, "recordings": list(records)}, indent=2, allow_nan=False)


def to_record(
    found: Identification | None,
    *,
    label: str | None = None,
    windows: Sequence[Window] | None = None,
    notes: Sequence[str] = (),
    error: str | None = None,
) -> dict[str, Any]:
    """One entry of "recordings" in a JSON document.

    Args:
        found: of one window or a batch; None for a recording that could not be used.
        label: name of the recording.
        windows: which part of the recording each window of the batch is.
        notes: sentences about its input.
        error: why it could not be used.
    """
    each = [] if found is None else split_windows(jax.device_get(found))
    spans: Sequence[Window | None] = windows or [None] * len(each)
    return {
        "recording": label,
        "error": error,
        "notes": list(notes),
        "windows": [
            _window_record(index, window, span)
            for index, (window, span) in enumerate(zip(each, spans, strict=True))
        ],
    }


def _pair(axes: Any) -> dict[str, Any] | None:
    """The axes of a universal joint by body; None where there is none."""
    if not np.all(np.isfinite(axes)):
        return None
    return dict(zip(("ground", "body"), np.asarray(axes).tolist(), strict=True))


def _window_record(index: int, found: Identification, span: Window | None) -> dict[str, Any]:
    status = Status(int(found.status_code))
    record: dict[str, Any] = {"index": index}
    record |= {name: getattr(span, name, None) for name in Window.__dataclass_fields__}
    record |= {"status": status.name, "message": status.message}
    if status.failed:
        return record | {"notes": []} | dict.fromkeys(_RESULT)
    entry = found.entry
    record |= {
        "notes": found.warnings,
        "name": found.name,
        "label": entry.label if entry else None,
        "probability": _plain(found.probability),
        "class_probability": _classes(found),
        "screw_probability": float(found.screw_probability),
        "pitch": _plain(float(found.pitch)),
        "universal_probability": float(found.universal_probability),
        "universal_axes": _pair(found.universal_axes),
        "noise": {"position": float(found.noise.position), "rotation": float(found.noise.rotation)},
        "lag": int(found.lag),
        "refined": bool(found.refined),
        "outliers": outlier_samples(found, span),
    }
    for group, types in TYPES.items():
        frame = getattr(found, group)
        named = {"type": str(types(int(frame.type_code))), "tied": tied_names(group, frame)}
        record[group] = named | _frame_record(frame)
        record[group]["free_probability"] = _plain(np.asarray(frame.free_probability).tolist())
    coupled = directions(np.asarray(found.linear.coupled_position))
    record["linear"]["coupled_position"] = np.reshape(coupled, (-1, 3)).tolist()
    record["linear"]["twin"] = _plain(found.linear.twin.tolist()) if found.linear.has_twin else None
    record["candidates"] = {
        group: {str(kind): _frame_record(_of_type(found, group, kind)) for kind in types}
        for group, types in TYPES.items()
    }
    return record


def _classes(found: Identification) -> list[dict[str, Any]]:
    """The likely classes, the likeliest first."""
    probability = np.asarray(found.class_probability)
    likely = [index for index in np.ndindex(probability.shape) if probability[index] > _LEAST]
    likely.sort(key=lambda index: -probability[index])
    return [
        {
            "type": str(LinearType(kind)),
            "rotations": rotations,
            "translations": translations,
            "probability": float(probability[kind, rotations, translations]),
        }
        for kind, rotations, translations in likely
    ]


def _of_type(found: Identification, group: str, kind: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[kind], getattr(found.candidates, group))


def _frame_record(frame: Any) -> dict[str, Any]:
    """Geometry of an angular or linear frame, or of a candidate."""
    numbers = {
        "rotvec": frame.rotvec,
        "axes": np.asarray(axes_of(frame.rotvec)).T,
        "dof": frame.dof,
        "rms": frame.rms,
        "norm": frame.norm,
        "free_rotation": frame.free_rotation,
        "position": getattr(frame, "position", None),
        "on_bounds": getattr(frame, "on_bounds", None),
        "agreement": getattr(frame, "agreement", None),
    }
    if numbers["position"] is not None:
        numbers["free_position"] = np.reshape(directions(frame.free_position), (-1, 3))
    return {name: _plain(np.asarray(value).tolist()) for name, value in numbers.items() if value is not None}


def _plain(value: Any) -> Any:
    """The value with null for what JSON cannot write."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
