"""An identification for people, as a table, and for programs, as JSON.

The JSON document (``to_json``, ``reframe-jax identify --json``) has the schema named by :data:`SCHEMA`.
Numbers are in SI units (m, rad, s, m/s, rad/s); NaN and infinities are written as null::

    {
      "schema": "reframe-jax/identification/1",
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
              "name": of the constraint, "label": letter in the catalogue, or null outside of it,
              "angular": {
                "type": "G" or "B", "tied": types that explain the motion as well, this one included,
                "rotvec": [3], "axes": [3 unit vectors], "dof": [3, 1 is free], "rms": [3], "norm": number,
                "free_rotation": [3 booleans, axes about which the frame can be turned],
              },
              "linear": {
                the same with "type" and "tied" of "BB", "GB", "GG", "BG", and
                "position": [3], "free_position": [unit vectors along which the position is undetermined],
                "twin": [3] another position that explains the window as well, or null,
              },
              "candidates": {
                "angular": {type: as "angular", without "type" and "tied"},
                "linear": {type: as "linear", without them and "twin", and "on_bounds", "agreement"},
              }
            }
          ]
        }
      ]
    }

Windows without a result have null for "name", "label", "angular", "linear" and "candidates".
Orientations are given in the body of the type's first letter (G ground, B body), positions in that of
the last.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from reframe_jax import kinematics, rotations
from reframe_jax.frames import AngularType, LinearType
from reframe_jax.kinematics import Discretization
from reframe_jax.products import apply, matmul
from reframe_jax.results import Identification
from reframe_jax.validate import Status

__all__ = ["SCHEMA", "Window", "frame_velocities", "to_document", "to_json", "to_record", "to_table"]

SCHEMA = "reframe-jax/identification/1"

_BODIES: dict[int, str] = {AngularType.G: "ground", AngularType.B: "body"}
_TYPES = {"angular": AngularType, "linear": LinearType}
_UNITS = {"angular": "rad/s", "linear": "m/s"}

_axes = jax.jit(rotations.rotation_exp)  # one compilation, where calling it op by op takes forty


@dataclass(frozen=True)
class Window:
    """Which part of a recording a window is.

    Attributes:
        start, stop: samples, from start up to but not including stop.
        start_time, stop_time: s, times of the first and the last sample.
    """

    start: int
    stop: int
    start_time: float
    stop_time: float


@partial(jax.jit, static_argnames="discretization")
def frame_velocities(
    poses: jax.Array,
    steps: jax.Array,
    found: Identification,
    discretization: Discretization = "chord",
) -> tuple[jax.Array, jax.Array]:
    """Velocities along the axes of the identified frames, over time: what is left where they are zero.

    For one window; use ``jax.vmap`` for many.

    Args:
        poses: (K+1, 4, 4), m.
        steps: (K,) sample times, s.
        found: identification of these poses.
        discretization: the one it was made with.

    Returns:
        Angular velocities (K, 3), rad/s, and linear velocities of the origin (K, 3), m/s. Their RMS are
        ``rms`` of the two frames, except along free axes where the position was left a choice.
    """
    rates = kinematics.angular_velocities(poses, steps, discretization)[found.angular.type_code]
    maps = kinematics.linear_velocity_maps(poses, steps, discretization)[found.linear.type_code]
    velocities = maps[..., 0] + apply(maps[..., 1:], found.linear.position)
    return matmul(rates, found.angular.axes), matmul(velocities, found.linear.axes)


def to_table(
    found: Identification, *, label: str | None = None, windows: Sequence[Window] | None = None
) -> str:
    """What a person reads: a paragraph for one window, a row per window for a batch.

    Args:
        found: of one window, or a batch.
        label: heading, such as the name of the recording.
        windows: which part of the recording each window of the batch is.
    """
    host = jax.device_get(found)
    if np.ndim(host.status_code):
        return "\n".join(_batch_table(_each(host), label, windows))
    status = Status(int(host.status_code))
    heading = f"{label}: {host.name}" if label else host.name
    if status.failed:
        return heading
    blocks = [heading, status.message, ""]
    for group in _TYPES:
        blocks += _frame_block(group, getattr(host, group))
    return "\n".join([*blocks, *_norms_block(host)])


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
    each = [] if found is None else _each(jax.device_get(found))
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


def _each(host: Identification) -> list[Identification]:
    """All windows of a batch, or the one that is none."""
    return [host[index] for index in np.ndindex(np.shape(host.status_code))]


# JSON


def _window_record(index: int, found: Identification, span: Window | None) -> dict[str, Any]:
    status = Status(int(found.status_code))
    record: dict[str, Any] = {"index": index}
    record |= {name: getattr(span, name, None) for name in Window.__dataclass_fields__}
    record |= {"status": status.name, "message": status.message}
    if status.failed:
        return record | dict.fromkeys(["name", "label", "angular", "linear", "candidates"])
    entry = found.entry
    record |= {"name": entry.name if entry else found.name, "label": entry.label if entry else None}
    for group, types in _TYPES.items():
        frame = getattr(found, group)
        named = {"type": str(types(int(frame.type_code))), "tied": _tied(group, frame)}
        record[group] = named | _frame_record(frame)
    record["linear"]["twin"] = _plain(found.linear.twin.tolist()) if found.linear.has_twin else None
    record["candidates"] = {
        group: {str(kind): _frame_record(_of_type(found, group, kind)) for kind in types}
        for group, types in _TYPES.items()
    }
    return record


def _of_type(found: Identification, group: str, kind: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[kind], getattr(found.candidates, group))


def _frame_record(frame: Any) -> dict[str, Any]:
    """Geometry of an angular or linear frame, or of a candidate."""
    numbers = {
        "rotvec": frame.rotvec,
        "axes": np.asarray(_axes(frame.rotvec)).T,
        "dof": frame.dof,
        "rms": frame.rms,
        "norm": frame.norm,
        "free_rotation": frame.free_rotation,
        "position": getattr(frame, "position", None),
        "on_bounds": getattr(frame, "on_bounds", None),
        "agreement": getattr(frame, "agreement", None),
    }
    if numbers["position"] is not None:
        numbers["free_position"] = np.reshape(_directions(frame.free_position), (-1, 3))
    return {name: _plain(np.asarray(value).tolist()) for name, value in numbers.items() if value is not None}


def _plain(value: Any) -> Any:
    """The value with null for what JSON cannot write."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _directions(projector: np.ndarray) -> list[np.ndarray]:
    """Unit vectors that span the range of a projector, their largest component positive."""
    values, vectors = np.linalg.eigh(projector)
    spanning = [vector for value, vector in zip(values, vectors.T, strict=True) if value > 0.5]
    return [vector * np.sign(vector[np.argmax(np.abs(vector))]) for vector in spanning]


def _tied(group: str, frame: Any) -> list[str]:
    return [str(kind) for kind in _TYPES[group] if frame.tied[kind]]


# Tables


def _vector(vector: Any, digits: int, width: int = 0) -> str:
    # adding zero after rounding takes the sign from a zero
    return "(" + ", ".join(f"{np.round(x, digits) + 0.0:{width}.{digits}f}" for x in vector) + ")"


def _frame_block(group: str, frame: Any) -> list[str]:
    kind = _TYPES[group](int(frame.type_code))
    others = [name for name in _tied(group, frame) if name != str(kind)]
    ties = f"; {_enumeration(others)} would do as well" if others else ""
    if isinstance(kind, LinearType):
        axes_in, origin_in = _BODIES[kind.orientation_body], _BODIES[kind.position_body]
        where = "axes and origin" if axes_in == origin_in else f"axes in the {axes_in}, origin"
        lines = [f"Linear frame {kind}: {where} fixed in the {origin_in}{ties}"]
    else:
        lines = [f"Angular frame {kind}: axes fixed in the {_BODIES[kind]}{ties}"]
    for i, axis in enumerate(np.asarray(_axes(frame.rotvec)).T):
        freedom = "free" if frame.dof[i] else "constrained"
        lines.append(
            f"  axis {i + 1}  {_vector(axis, 3, 6)}  {_speed(frame.rms[i]):>8} {_UNITS[group]:5}  {freedom}"
        )
    if isinstance(kind, LinearType):
        lines.append(f"  origin  {_vector(frame.position, 4)} m in the {origin_in}")
        lines += _choice_of_position(_directions(frame.free_position))
        if frame.has_twin:
            away = np.linalg.norm(frame.twin - frame.position)
            lines.append(
                f"      or  {_vector(frame.twin, 4)} m, {away:.2g} m away, explains the window as well"
            )
    turns = [i for i in range(3) if frame.free_rotation[i]]
    if len(turns) == 3:
        lines.append("          the orientation is not determined")
    elif turns:
        first, second = (i + 1 for i in range(3) if i not in turns)
        lines.append(f"          axes {first} and {second} can be turned about axis {turns[0] + 1}")
    return [*lines, ""]


def _speed(value: float) -> str:
    """A velocity; what is not even rounding of one is zero."""
    return f"{value if value > 1e-18 else 0:.3g}"


def _choice_of_position(directions: list[np.ndarray]) -> list[str]:
    """In words, which directions of the position the motion leaves open."""
    if not directions:
        return []
    if len(directions) == 3:
        return ["          not determined: the origin closest to the motion is given"]
    along = " and ".join(_vector(direction, 3) for direction in directions)
    return [f"          not determined along {along}"]


def _norms_block(found: Identification) -> list[str]:
    lines, tied = [], False
    for group, types in _TYPES.items():
        frame = getattr(found, group)
        entries = []
        for kind in types:
            mark = "*" if kind == int(frame.type_code) else "~" if frame.tied[kind] else " "
            tied |= mark == "~"
            entries.append(f"{kind} {_speed(frame.norms[kind])}{mark}")
        lines.append(f"Norms   {group:7}  {'  '.join(entries).rstrip()}  {_UNITS[group]}")
    lines.append("        * lowest" + (", ~ tied: explains the motion as well" if tied else ""))
    return lines


def _enumeration(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def _batch_table(
    each: list[Identification], label: str | None, windows: Sequence[Window] | None
) -> list[str]:
    columns = ["window", "name", "angular", "linear", "origin [m]", "status"]
    rows = [_batch_row(index, found) for index, found in enumerate(each)]
    if windows is not None:
        columns.insert(1, "time [s]")
        for row, window in zip(rows, windows, strict=True):
            row.insert(1, f"{window.start_time:.2f} - {window.stop_time:.2f}")
    widths = [max(map(len, cells)) for cells in zip(columns, *rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [columns, *rows]
    ]
    count = f"{len(each)} window{'' if len(each) == 1 else 's'}"
    statuses = sorted({Status(int(found.status_code)) for found in each} - {Status.OK})
    legend = [f"{status.name}: {status.message}" for status in statuses]
    ties = any("~" in cell for row in rows for cell in row)
    twins = any(found.linear.has_twin for found in each)
    return [
        f"{label}: {count}" if label else count,
        *lines,
        *(["~ tied: explains the motion as well"] if ties else []),
        *(["+ another origin explains the motion as well"] if twins else []),
        *legend,
    ]


def _batch_row(index: int, found: Identification) -> list[str]:
    status = Status(int(found.status_code))
    if status.failed:
        return [str(index), "-", "-", "-", "-", status.name]
    kinds = []
    for group, types in _TYPES.items():
        frame = getattr(found, group)
        kind = str(types(int(frame.type_code)))
        kinds.append("~".join([kind, *(name for name in _tied(group, frame) if name != kind)]))
    origin = _vector(found.linear.position, 3, 6) + ("+" if found.linear.has_twin else "")
    return [str(index), found.name, *kinds, origin, status.name]
