"""Tasks on the simulated arm for the segmentation benchmark: approach, contact, motion, release."""

from typing import Any

import jax
import numpy as np

import reframe_jax as rf

__all__ = ["arm_rows", "print_arm"]

_DT = 0.02  # s
_DURATIONS = (4.0, 6.0, 4.0)  # s, of approach, motion under the constraint, and release
_BATCH = 16  # random demonstrations per constraint, of which some are infeasible
_CLOSE = 0.1  # s


def arm_rows(count: int) -> list[dict[str, Any]]:
    """Segment demonstrations of every constraint between two free motions.

    Args:
        count: number of usable demonstrations per constraint, at most 16.
    """
    if count == 0:
        return []
    from reframe_jax.simulation import arm  # the arm needs MuJoCo; the rest of the benchmark does not

    rows = []
    for number, (label, entry) in enumerate(rf.CONSTRAINTS.items()):
        made = jax.device_get(
            arm.demonstrate_sequence(
                ["unconstrained", label, "unconstrained"],
                jax.random.key(number),
                batch=_BATCH,
                durations=_DURATIONS,
                dt=_DT,
                pause=False,
                spread=arm.SPREAD,
                imperfections=arm.ENCODER_GRADE,
            )
        )
        for i in np.flatnonzero(made.status_code == arm.RolloutStatus.OK)[:count]:
            found = rf.segment(made.poses[i], times=made.times)
            right = len(found) == len(_DURATIONS)
            indices = [b.index for b in found.boundaries]
            misses = np.subtract(indices, made.boundaries) * _DT if right else np.zeros(0)
            named = [segment.name for segment in found.segments] == [
                "Unconstrained",
                entry.name,
                "Unconstrained",
            ]
            rows.append({"label": label, "right": right, "named": named, "misses": np.abs(misses).tolist()})
    return rows


def print_arm(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Print the metrics of the tasks of the arm."""
    misses = np.array([miss for row in rows for miss in row["misses"]])
    metrics = {
        "right number": float(np.mean([row["right"] for row in rows])),
        "right names": float(np.mean([row["named"] for row in rows])),
        f"boundaries within {_CLOSE} s": float(np.mean(misses <= _CLOSE + 1e-9)),
    }
    print(f"\n{len(rows)} tasks of the simulated arm: approach, contact, motion, release")
    for name, value in metrics.items():
        print(f"  {name:<32} {value:7.1%}")
    print(f"  {'median error of boundaries':<32} {np.median(misses):6.3f} s")
    merged = sorted({row["label"] for row in rows if not row["right"]})
    if merged:
        print(f"  wrong number of segments in some of {', '.join(merged)}")
    return {f"arm {name}": value for name, value in metrics.items()} | {
        "arm median s": float(np.median(misses))
    }
