"""Speed of simulated demonstrations, compared with C MuJoCo, and errors of their identification.

Speed by batch size: ``panda.demonstrate`` (with exact constraint, guide and recording, steps of 10 ms,
without compilation), and the threaded ``rollout`` of C MuJoCo. The rollout simulates the same arm, welded to
the same mechanism, under constant torques, with steps of 5 ms: the longest steps at which the weld is equally
accurate.

Errors: all twelve constraints, in the layout of the paper's Table 4, with the paper's values for A, B, D, I
and K. The set-ups are a rigid one with encoder noise, a compliant one, and a compliant one with the speeds
and RMS values of Table 4. The column "follows" is the effect of the compliance on the axis of a single free
rotation: the part of the constrained rotations that is proportional to the free rotation, as an angle, and as
a fraction of their RMS. Poses cannot distinguish this part from a tilted axis. Other compliant motion hardly
affects the result.
"""

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from benchmarks.common import write_metrics
from benchmarks.mechanism import mechanism_joints, mechanism_model, weld
from benchmarks.paper_common import LABELS
from benchmarks.paper_table4 import PAPER, SETUPS, Setup, identify_all
from reframe_jax.simulation import arm as panda

DURATION = 5.0
C_STEP = 0.005

KEY = 20250  # a key that was not used in the development of the arm and its guide


def time_demonstrations(batch: int, repeats: int) -> tuple[float, float, panda.Demonstration]:
    """Time of a warm call, additional time of the first call, s, and the demonstrations."""
    frame = panda.frame_on_arm("K")
    first, times = 0.0, []
    for i in range(repeats + 1):
        start = time.perf_counter()
        made = jax.block_until_ready(
            panda.demonstrate(
                frame, jax.random.key(KEY + i), batch=batch, duration=DURATION, spread=panda.SPREAD
            )
        )
        times.append(time.perf_counter() - start)
    first = times.pop(0)
    return min(times), first - min(times), made


def time_c_mujoco(batch: int, threads: int) -> tuple[float, float]:
    """Demonstrations per second of C MuJoCo with a mechanism (K), and the largest gap at the weld, um."""
    frame = panda.frame_on_arm("K")
    model = mechanism_model(panda.PANDA, mechanism_joints(frame), C_STEP)
    data = weld(model, frame, jnp.asarray(panda.PANDA.home), panda.PANDA)
    grip, tcp = model.site("grip").id, model.site("tcp").id
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    steps = round(DURATION / C_STEP)
    rng = np.random.default_rng(0)
    t = C_STEP * np.arange(steps)
    waves = np.sin(rng.uniform(2, 6, (batch, 7, 1)) * t + rng.uniform(0, 6, (batch, 7, 1)))
    control = np.zeros((batch, steps, model.nv))
    control[..., :7] = 0.5 * np.swapaxes(waves, 1, 2)
    workers = [mujoco.MjData(model) for _ in range(threads)]
    times = []
    for _ in range(3):
        start = time.perf_counter()
        states, _ = mujoco.rollout.rollout(
            model,
            workers,
            np.tile(state, (batch, 1)),
            control,
            control_spec=mujoco.mjtState.mjSTATE_QFRC_APPLIED,
        )
        times.append(time.perf_counter() - start)
    gap = 0.0
    for row in states[0, ::10]:
        mujoco.mj_setState(model, data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(model, data)
        gap = max(gap, float(np.linalg.norm(data.site_xpos[tcp] - data.site_xpos[grip])))
    return batch / min(times), 1e6 * gap


def score(count: int, setup: Setup, title: str) -> dict[str, float]:
    """Demonstrate and identify all constraints, and print the results in the layout of Table 4."""
    found = identify_all(jax.random.key(KEY), count, count, setup)
    print(f"\n{title}: {count} demonstrations each; medians, the paper's Table 4 in brackets")
    print(
        f"{'':3}{'rms of angular axes, mrad/s':>40}{'of linear axes, mm/s':>38}"
        f"{'types':>7}{'dof':>6}{'angular, deg':>15}{'linear, deg':>14}{'position, mm':>15}"
        f"{'follows, deg, %':>17}"
    )
    rms, errors = np.median(found["rms"], axis=1), np.median(found["errors"], axis=1)
    follows = np.median(found["follows"], axis=1)
    shares = np.stack([found["tied"].mean(axis=1), found["dof"].mean(axis=1)], axis=1)
    for i, label in enumerate(LABELS):
        print(table_row(label, rms[i, :3], rms[i, 3:], shares[i], errors[i], follows[i]))
    largest, violation = np.nanmax(errors, axis=0), found["violation"].max(axis=(0, 1))
    return {
        "types_correct": float(shares[:, 0].mean()),
        "dof_correct": float(shares[:, 1].mean()),
        "angular_error_deg": float(largest[0]),
        "linear_error_deg": float(largest[1]),
        "position_error_mm": float(largest[2]),
        "max_violation_mrad": float(violation[0]),
        "max_violation_um": float(1e3 * violation[1]),
    }


def table_row(
    label: str,
    angular: np.ndarray,
    linear: np.ndarray,
    shares: np.ndarray,
    errors: np.ndarray,
    follows: np.ndarray,
) -> str:
    """Format a row of the table, with the paper's values in brackets."""
    paper = PAPER.get(label)

    def triple(values: np.ndarray, index: int) -> str:
        ours = "/".join(f"{value:.1f}" for value in values)
        if paper is None:
            return ours
        theirs = (paper.angular_rms, paper.linear_rms)[index]
        return ours + f" ({'/'.join(f'{mean:.1f}' for mean, _ in theirs)})"

    def error(i: int) -> str:
        if np.isnan(errors[i]):
            return "-"
        return f"{errors[i]:.3f}" + (f" ({paper.errors[i][0]:.2f})" if paper else "")

    return (
        f"{label:3}{triple(angular, 0):>40}{triple(linear, 1):>38}"
        f"{100 * shares[0]:>5.0f} %{100 * shares[1]:>4.0f} %{error(0):>15}{error(1):>14}{error(2):>15}"
        + ("" if np.isnan(follows[0]) else f"{follows[0]:>12.3f} {100 * follows[1]:>4.0f}")
    )


def run(batches: Sequence[int], count: int, repeats: int) -> dict[str, float]:
    """Run both parts and print the tables."""
    threads = len(os.sched_getaffinity(0))
    print(f"{threads} cores, {jax.devices()[0].platform}, demonstrations of {DURATION:g} s")
    rates, compiling = {}, 0.0
    for batch in batches:
        seconds, extra, _ = time_demonstrations(batch, repeats)
        rates[batch] = batch / seconds
        compiling = max(compiling, extra)
        print(
            f"demonstrate, batch {batch:>6}: {rates[batch]:>9.1f} demonstrations/s, "
            f"first call {extra:.1f} s longer"
        )
    c_rate, gap = time_c_mujoco(64, threads)
    print(f"C MuJoCo, {threads} threads      : {c_rate:>9.1f} demonstrations/s, gap at the weld {gap:.1f} um")
    rigid = score(count, SETUPS["rigid"], "Rigid, encoder grade")
    soft = score(count, SETUPS["realistic"], "Compliant, encoder grade")
    matched = score(count, SETUPS["matched"], "Compliance and speed matched to the paper's rms")
    print(
        f"\nlargest violation of a rigid constraint: {rigid['max_violation_um']:.1f} um, "
        f"{rigid['max_violation_mrad']:.3f} mrad"
    )
    return {
        "demonstrations_per_second": max(rates.values()),
        **{f"demonstrations_per_second_batch_{batch}": rate for batch, rate in rates.items()},
        "mujoco_c_demonstrations_per_second": c_rate,
        "mujoco_c_gap_um": gap,
        "compile_s": compiling,
        **rigid,
        **{f"compliant_{name}": value for name, value in soft.items() if "violation" not in name},
        **{f"matched_{name}": value for name, value in matched.items() if "violation" not in name},
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.panda", description=__doc__)
    parser.add_argument(
        "--batch", type=int, nargs="+", help="batch sizes (1, 16, 64, 256; 4096, 16384 on a GPU)"
    )
    parser.add_argument(
        "--count", type=int, default=64, help="demonstrations per constraint to identify (64)"
    )
    parser.add_argument("--single", action="store_true", help="in 32 bits")
    parser.add_argument(
        "--quick", action="store_true", help="batch size 64 only, and 64 demonstrations per constraint"
    )
    parser.add_argument("--json", type=Path, help="file to write the metrics to")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", not options.single)
    on_gpu = jax.devices()[0].platform == "gpu"
    batches = options.batch or ([4096, 16384] if on_gpu else [1, 16, 64, 256])
    result = run([64], 64, 2) if options.quick else run(batches, options.count, 3)
    write_metrics(options.json, result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
