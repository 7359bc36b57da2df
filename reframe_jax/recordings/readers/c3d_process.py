"""Reader of a C3D file in a separate process, because damaged files can crash or block ezc3d.

Run as a script with the path of the file and the path of the .npz to write.
"""

import re
import sys
from collections.abc import Mapping
from typing import Any


def extract(path: str, out: str) -> None:
    """Write the arrays that :mod:`reframe_jax.recordings.readers.c3d` needs.

    Args:
        path: the C3D file.
        out: the .npz: ``markers`` (M,) labels, ``points`` (N, M, 3), NaN where a marker is missing,
            ``rotations`` (R,) labels, ``poses`` (N', R, 4, 4), ``rates`` (2,) of both in Hz, and ``unit``.
    """
    import ezc3d
    import numpy as np

    content = ezc3d.c3d(path)
    groups, data = content["parameters"], content["data"]
    points = np.asarray(data["points"], float)[:3].transpose(2, 1, 0)
    lost = (points == 0).all(axis=2) | (data["meta_points"]["residuals"][0].T < 0)
    rotation = groups.get("ROTATION", {})
    rate = _number(groups["POINT"], "RATE")
    np.savez(
        out,
        markers=np.asarray(_labels(groups["POINT"])[: points.shape[1]], str),
        points=np.where(lost[..., None], np.nan, points),
        rotations=np.asarray(_labels(rotation), str),
        poses=np.asarray(data["rotations"], float).transpose(3, 2, 0, 1),
        rates=[rate, _number(rotation, "RATE") or rate * (_number(rotation, "RATIO") or 1)],
        unit="".join(groups["POINT"]["UNITS"]["value"][:1]).strip(),
    )


def _labels(group: Mapping[str, Any]) -> list[str]:
    """Return the labels of a group; each parameter LABELS, LABELS2, ... contains up to 255."""
    names = sorted(
        (name for name in group if re.fullmatch(r"LABELS\d*", name)), key=lambda name: name[6:].zfill(9)
    )
    return [label.strip() for name in names for label in group[name]["value"]]


def _number(group: Mapping[str, Any], name: str) -> float:
    values = group[name]["value"] if name in group else []
    return float(values[0]) if len(values) else 0.0


if __name__ == "__main__":
    try:
        extract(*sys.argv[1:])
    except Exception as error:
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
