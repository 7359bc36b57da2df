"""Write identifications as flat columns, one row per window, for data frames, Parquet and CSV.

All three formats have the same columns, with units in the names. Axes are numbered as in ``LinearFrame``:
constrained axes first, then free axes, each by increasing amplitude. Rows of windows that failed contain NaN,
0, False or an empty text.
"""

import csv
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from reframe_jax.export.common import TYPES, Window
from reframe_jax.identification.results import Identification
from reframe_jax.storage.parts import PARQUET

if TYPE_CHECKING:
    import pandas

Columns = dict[str, np.ndarray]
"""Column names, each with its values (windows,); columns of text are arrays of objects."""

_texts = partial(np.array, dtype=object)
_floats = partial(np.asarray, dtype=np.float64)
_UNITS = {"angular": "rad_s", "linear": "m_s"}


def to_frame(
    found: Identification, *, label: str | None = None, windows: Sequence[Window] | None = None
) -> "pandas.DataFrame":
    """Return an identification as a pandas data frame, one row per window.

    Columns are flat and typed, with units in their names: ``linear_position_x_m``, ``angular_rms_1_rad_s``.
    ``frame.to_parquet`` and ``frame.to_csv`` write the same content as ``reframe-jax identify --parquet`` and
    ``--csv``. Arguments and errors as in :func:`to_table`; an ImportError is raised without pandas. The label
    fills the column ``recording``. Without ``windows``, the columns ``start`` and ``stop`` are -1 and the
    times are NaN.
    """
    try:
        import pandas
    except ImportError as error:
        raise ImportError("to_frame needs pandas: pip install 'reframe-jax[pandas]'") from error
    return pandas.DataFrame(to_columns(found, label=label, windows=windows))


def to_columns(
    found: Identification, *, label: str | None = None, windows: Sequence[Window] | None = None
) -> Columns:
    """Return the columns of :func:`to_frame` as NumPy arrays; the arguments and errors are the same."""
    host: Identification = jax.tree.map(np.asarray, jax.device_get(found))
    batch = host.status_code.shape
    number = int(np.prod(batch, dtype=int))
    host = jax.tree.map(lambda leaf: leaf.reshape(number, *leaf.shape[len(batch) :]), host)
    if windows is not None and len(windows) != number:
        raise ValueError(f"Expected {number} windows, one per identification, not {len(windows)}.")
    each = list(host)
    failed = np.array([one.status.failed for one in each], bool)
    entries = [None if bad else one.entry for bad, one in zip(failed, each, strict=True)]
    columns: Columns = {"recording": _texts([label or ""] * number), "window": np.arange(number)}
    spans = [Window(-1, -1, np.nan, np.nan)] * number if windows is None else windows
    for name, kind in (("start", np.int64), ("stop", np.int64), ("start_time", float), ("stop_time", float)):
        unit = "_s" if kind is float else ""
        columns[name + unit] = np.array([getattr(span, name) for span in spans], kind)
    columns |= {
        "status": _texts([one.status.name for one in each]),
        "name": _texts(["" if bad else one.name for bad, one in zip(failed, each, strict=True)]),
        "label": _texts([entry.label if entry else "" for entry in entries]),
        "probability": np.asarray(host.probability, float),
        "pitch_m_rad": _floats(host.pitch),
        **{
            f"universal_{body}_{name}": _floats(host.universal_axes[:, i, j])
            for i, body in enumerate(("ground", "body"))
            for j, name in enumerate("xyz")
        },
        "noise_position_m": _floats(host.noise.position),
        "noise_rotation_rad": _floats(host.noise.rotation),
        "scale_samples": np.asarray(host.scale, np.int64),
        "outliers": np.asarray(np.sum(~host.counted, axis=-1), np.int64),
    }
    for group in TYPES:
        columns |= _frame_columns(group, getattr(host, group), failed)
    return columns


def write_csv(path: Path, tables: Sequence[Columns]) -> None:
    """Write tables with the same columns as one CSV file; numbers keep full precision."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file)
        writer.writerows(tables[:1])  # the names
        for columns in tables:
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def write_parquet(path: Path, tables: Sequence[Columns]) -> None:
    """Write tables with the same columns as one Parquet file; an ImportError is raised without pyarrow."""
    arrow = PARQUET.library()
    arrow.parquet.write_table(arrow.concat_tables([arrow.table(table) for table in tables]), path)


def _frame_columns(group: str, frame: Any, failed: np.ndarray) -> Columns:
    """Columns of the angular or linear frame: type, ties, axes, degrees of freedom, velocities, origin."""
    kinds: Any = TYPES[group]
    codes = [int(code) for code in frame.type_code]
    axes = np.asarray(frame.axes, float)
    columns = {
        "type": _texts(["" if bad else str(kinds(code)) for bad, code in zip(failed, codes, strict=True)]),
        "tied": _texts([" ".join(str(kind) for kind in kinds if row[kind]) for row in frame.tied]),
        "norm_" + _UNITS[group]: _floats(frame.norm),
    }
    for axis in range(3):
        place = f"{axis + 1}"
        columns |= {f"axis_{place}_{name}": axes[:, i, axis] for i, name in enumerate("xyz")}
        columns[f"free_{place}"] = np.asarray(frame.dof[:, axis], bool)
        columns[f"free_probability_{place}"] = _floats(frame.free_probability[:, axis])
        columns[f"rms_{place}_{_UNITS[group]}"] = _floats(frame.rms[:, axis])
        columns[f"amplitude_{place}_{_UNITS[group].removesuffix('_s')}"] = _floats(frame.amplitude[:, axis])
        columns[f"turns_about_{place}"] = np.asarray(frame.free_rotation[:, axis], bool)
    if group == "linear":
        for i, name in enumerate("xyz"):
            columns[f"position_{name}_m"] = _floats(frame.position[:, i])
        directions = np.trace(frame.free_position, axis1=-2, axis2=-1)
        columns["open_directions"] = np.where(failed, 0, np.round(np.nan_to_num(directions))).astype(np.int64)
    return {f"{group}_{name}": column for name, column in columns.items()}
