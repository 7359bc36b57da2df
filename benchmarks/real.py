"""What ``identify`` says of recordings, beside what their positions alone say.

Every recording is identified whole, with the defaults and with the paper's objective (chords of one sample,
and the paper's thresholds). By the name of the file:

- ``kitchen_door``, ``champ_microwave``: positions lie on a circle, which a robust fit finds. Printed are the
  residual of that fit, the distance from the circle's axis to the origin of the frame that is oriented in the
  body and placed in the ground (BG), and the angle from the circle's axis to the one that turned fastest;
- ``kitchen_drawer``: positions lie on a line. Printed is the angle between it and the fastest axis of the
  better of the frames that are oriented in the ground;
- ``contour``: the origin of the frame fixed in the tool (BB), by the length of the chords up to 0.35 s, and
  how far these origins lie from their mean; this needs an ``identify`` that takes a lag;
- anything else: the class.

Of the default's frame, it is printed how far the measured origin goes along the constrained axis along which
it goes farthest, in standard deviations of the noise and as a share of the way of the body. What exceeds a
few noises is error that changes slowly: a free axis that goes as far looks the same.

The positions of trackers are far better than their rotations, so circle and line serve as the truth.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import reframe_jax as rf
from benchmarks.common import machine, new_parser
from benchmarks.determined import distances
from benchmarks.lags import identify_at, takes_lag

DATA = Path(__file__).parents[2] / "shared" / "data"
KINDS = {
    "kitchen_door": "door",
    "champ_microwave": "door",
    "kitchen_drawer": "drawer",
    "contour": "contour",
    "wiping": "whole",
    "grating": "whole",
    "pouring": "whole",
}
CHORD = 0.35  # s, the longest chord along a contour
LAGS = 6  # at most, of a contour
_SCATTERS = 3.0  # distances beyond so many robust deviations hardly count in a fit
_ROUNDS = 6  # of a fit, each with the deviation left by the one before
_GAUSSIAN = 1.4826  # standard deviation over median absolute deviation


@dataclass(frozen=True)
class Axis:
    """A line in the ground: direction (3,), point (3,) m, and the RMS residual without outliers, m."""

    direction: np.ndarray
    point: np.ndarray
    residual: float


def circle_axis(positions: np.ndarray) -> Axis:
    """Axis of the circle through most of the positions (N, 3)."""
    mean = np.median(positions, axis=0)
    normal = np.linalg.svd(positions - mean, full_matrices=False)[2][2]
    flat = positions - mean
    flat = flat - np.outer(flat @ normal, normal)
    design = np.column_stack([2 * flat, np.ones(len(flat))])
    centre = np.linalg.lstsq(design, np.sum(flat**2, axis=1), rcond=1e-9)[0][:3]
    start = np.concatenate([normal, centre, [np.median(np.linalg.norm(flat - centre, axis=1))]])

    def miss(unknown: np.ndarray) -> np.ndarray:
        """Distances to the circle along its axis and along its radii, (N, 2), m."""
        direction = unknown[:3] / np.linalg.norm(unknown[:3])
        away = positions - mean - unknown[3:6]
        along = away @ direction
        out = np.linalg.norm(away - np.outer(along, direction), axis=1) - unknown[6]
        return np.column_stack([along, out])

    found, residual = _robust(miss, start)
    return Axis(found[:3] / np.linalg.norm(found[:3]), mean + found[3:6], residual)


def line_axis(positions: np.ndarray) -> Axis:
    """The line through most of the positions (N, 3)."""
    mean = np.median(positions, axis=0)
    basis = np.linalg.svd(positions - mean, full_matrices=False)[2]

    def miss(unknown: np.ndarray) -> np.ndarray:
        """Distances from the line, (N, 3), m."""
        direction = unknown[:3] / np.linalg.norm(unknown[:3])
        away = positions - mean - unknown[3:]
        return np.asarray(away - np.outer(away @ direction, direction))

    found, residual = _robust(miss, np.concatenate([basis[0], np.zeros(3)]))
    return Axis(found[:3] / np.linalg.norm(found[:3]), mean + found[3:], residual)


def _robust(miss: Any, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Unknowns that minimise distances (N, d) whatever a few of them are, and the RMS of the others, m."""
    scale = _deviation(miss(start))
    for _ in range(_ROUNDS):
        fit = least_squares(
            lambda x: miss(x).ravel(), start, loss="cauchy", f_scale=_SCATTERS * scale, x_scale="jac"
        )
        start, scale = fit.x, _deviation(miss(fit.x))
    distances = np.linalg.norm(miss(start), axis=1)
    near = distances <= _SCATTERS * scale
    return start, float(np.sqrt(np.mean(distances[near] ** 2)))


def _deviation(misses: np.ndarray) -> float:
    return max(_GAUSSIAN * float(np.median(np.linalg.norm(misses, axis=1))), 1e-9)


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two lines."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(float(a @ b)))))


def hinge_figures(found: rf.Identification, circle: Axis) -> dict[str, float]:
    """From the circle's axis: distance in mm of the BG origin, and degrees to the fastest axis of G."""
    candidates = found.candidates
    assert candidates.linear.position is not None
    away = np.asarray(candidates.linear.position[int(rf.LinearType.BG)]) - circle.point
    away = away - (away @ circle.direction) * circle.direction
    axis = _fastest_axis(candidates.angular, rf.AngularType.G)
    return {
        "distance_mm": 1e3 * float(np.linalg.norm(away)),
        "angle_deg": angle_between(axis, circle.direction),
    }


def slide_figures(found: rf.Identification, line: Axis) -> dict[str, float]:
    """Degrees between the line and the fastest axis of GB or GG, whichever has the lower norm."""
    norms = np.asarray(found.linear.norms)
    kind = min((rf.LinearType.GB, rf.LinearType.GG), key=lambda kind: float(norms[int(kind)]))
    return {"angle_deg": angle_between(_fastest_axis(found.candidates.linear, kind), line.direction)}


def _fastest_axis(candidates: rf.Candidates, kind: int) -> np.ndarray:
    rotvec = np.asarray(candidates.rotvec[int(kind)])
    angle = float(np.linalg.norm(rotvec))
    z, unit = np.array([0.0, 0.0, 1.0]), rotvec / (angle or 1.0)
    turned = z * np.cos(angle) + np.cross(unit, z) * np.sin(angle) + unit * unit[2] * (1 - np.cos(angle))
    return np.asarray(turned)


def tool_points(recording: rf.Recording) -> list[dict[str, Any]]:
    """For some lags up to 0.35 s: winning type, and the BB origin in m."""
    dt = float(np.median(np.diff(recording.times)))
    longest = max(1, int(CHORD / dt)) if takes_lag() else 1
    rows = []
    for lag in np.unique(np.geomspace(1, longest, LAGS).round().astype(int)):
        found = identify_at(int(lag), recording.poses, times=recording.times)
        assert found.candidates.linear.position is not None
        point = np.asarray(found.candidates.linear.position[int(rf.LinearType.BB)])
        rows.append({"lag": int(lag), "type": str(found.linear.frame_type), "tool_point_m": point.tolist()})
    return rows


def class_of(found: rf.Identification) -> dict[str, Any]:
    """Name, type and RMS velocities (rad/s, m/s)."""
    return {
        "name": found.name,
        "type": str(found.linear.frame_type),
        "angular_rms": np.asarray(found.angular.rms).tolist(),
        "linear_rms": np.asarray(found.linear.rms).tolist(),
    }


def farthest_held(found: rf.Identification, recording: rf.Recording) -> dict[str, float]:
    """How far the origin goes along a constrained axis: in noises, and as a share of the way of the body."""
    counted = np.asarray(found.counted)
    poses, dt = recording.poses[counted], float(np.median(np.diff(recording.times)))
    candidates, kind = found.candidates, int(found.linear.type_code)
    assert candidates.linear.position is not None
    rotvecs = jnp.asarray(candidates.angular.rotvec)[None], jnp.asarray(candidates.linear.rotvec)[None]
    _, moves, levers = distances(
        jnp.asarray(poses)[None], dt, rotvecs, jnp.asarray(candidates.linear.position)[None]
    )
    held = np.asarray(moves)[0, kind][np.asarray(found.linear.dof) == 0]
    if held.size == 0:
        return {}
    noise = np.hypot(float(found.noise.position), float(found.noise.rotation) * float(levers[0, kind]))
    way = np.sqrt(np.sum(np.var(poses[:, :3, 3], axis=0)))
    return {"held_noises": float(held.max() / noise), "held_share": float(held.max() / way)}


def examine(file: Path) -> dict[str, Any]:
    """Everything about one recording."""
    recording = rf.load_recording(file)
    options: dict[str, Any] = {"times": recording.times}
    found = rf.identify(recording.poses, **options)
    # without a lag to give, the default is the paper's objective already
    by_one = identify_at(1, recording.poses, **options, thresholds=rf.Thresholds(0.160, 0.037))
    kind = next((kind for prefix, kind in KINDS.items() if file.name.startswith(prefix)), "whole")
    both = {"default": found, "lag 1": by_one}
    row: dict[str, Any] = {"file": file.name, "kind": kind, "poses": len(recording.poses)}
    row["classes"] = {name: class_of(each) for name, each in both.items()}
    row |= farthest_held(found, recording)
    positions = recording.poses[:, :3, 3]
    if kind in ("door", "drawer"):
        fit, figures = (circle_axis, hinge_figures) if kind == "door" else (line_axis, slide_figures)
        axis = fit(positions)
        row["residual_mm"] = 1e3 * axis.residual
        row["figures"] = {name: figures(each, axis) for name, each in both.items()}
    if kind == "contour":
        row["lags"] = tool_points(recording)
        points = np.array([at["tool_point_m"] for at in row["lags"]])
        row["tool_point_m"] = points.mean(axis=0).tolist()
        row["spread_mm"] = 1e3 * float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
    return row


def show(row: dict[str, Any]) -> None:
    """Print what was found in one recording."""
    residual = f"  residual {row['residual_mm']:.2f} mm" if "residual_mm" in row else ""
    print(f"{row['file']}  {row['poses']} poses{residual}")
    for name, kind in row["classes"].items():
        figures = row.get("figures", {}).get(name, {})
        distance = f"{figures['distance_mm']:>9.1f} mm" if "distance_mm" in figures else " " * 12
        angle = f"{figures['angle_deg']:>8.2f} deg" if "angle_deg" in figures else " " * 12
        print(f"  {name:8}{distance}{angle}  {kind['type']}  {kind['name']}")
    if "held_noises" in row:
        noises, share = row["held_noises"], row["held_share"]
        print(f"  held axes go up to {noises:.0f} noises, {share:.3f} of the way of the body")
    for at in row.get("lags", []):
        point = " ".join(f"{1e3 * x:8.1f}" for x in at["tool_point_m"])
        print(f"  lag {at['lag']:<4} {at['type']}  tool point {point} mm")
    if len(row.get("lags", [])) > 1:
        print(f"  spread of the tool point: {row['spread_mm']:.1f} mm")
    sys.stdout.flush()


def summarise(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Medians and roots of mean squares over the doors and over the drawers."""
    metrics = {}
    for kind in ("door", "drawer"):
        for name in ("default", "lag 1"):
            figures = [row["figures"][name] for row in rows if row["kind"] == kind]
            for quantity in figures[0] if figures else ():
                values = np.array([each[quantity] for each in figures])
                prefix = f"{kind}_{name.replace(' ', '')}_{quantity}"
                metrics[f"{prefix}_median"] = float(np.median(values))
                metrics[f"{prefix}_rms"] = float(np.sqrt(np.mean(values**2)))
    return metrics


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = new_parser("real", __doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of recordings (../shared/data)")
    parser.add_argument("--only", nargs="+", metavar="PREFIX", help="files whose names start so")
    parser.add_argument("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    wanted = tuple(options.only or [""])
    files = [file for file in sorted(options.data.glob("*.csv")) if file.name.startswith(wanted)]
    for prefix in KINDS:
        if prefix.startswith(wanted) and not any(file.name.startswith(prefix) for file in files):
            print(f"skipped: there is no {prefix}*.csv in {options.data}", file=sys.stderr)
    if not takes_lag():
        print("identify takes no lag here: default and lag 1 are the same", file=sys.stderr)
    rows = []
    for file in files:
        rows.append(examine(file))
        show(rows[-1])
    metrics = summarise(rows)
    for name, value in metrics.items():
        print(f"{name.replace('_', ' '):36}{value:>9.2f}")
    if options.json:
        record = {"machine": machine(), "metrics": metrics, "recordings": rows}
        options.json.write_text(json.dumps(record, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
