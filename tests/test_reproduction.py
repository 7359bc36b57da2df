"""Reproduction: frames decide how the arm moves, what reacts, and whether it arrives."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks.paper_figure5 import erroneous_frames
from reframe_jax.constraints.frame import frame_arrays, locate
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation import reproduction

TRIALS = 8  # one compiled program for this module, and one for demonstrations
KEY = jax.random.key(5)
CONTROLLERS = {
    "wrench": reproduction.constant_wrench(),
    "hybrid": reproduction.hybrid(),
    "impedance": reproduction.axis_impedance(),
}


def batch(label: str) -> rf.ConstraintFrame:
    frame = panda.frame_on_arm(label, start=reproduction.ROOMY)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (TRIALS, 3)), frame)


def run(truth: rf.ConstraintFrame, frames: Any, **options: Any) -> reproduction.Trials:
    return jax.device_get(reproduction.reproduce(truth, frames, **options))


@pytest.mark.parametrize("label", list(rf.CONSTRAINTS))
def test_exact_frames_reach_the_stops(label: str) -> None:
    truth = batch(label)
    trials = run(truth, truth)
    free = np.array((*truth.angular_dof, *truth.linear_dof), dtype=bool)
    assert np.all(trials.completed)
    assert np.all(trials.completion_time < 3)
    assert np.all(trials.status_code == panda.RolloutStatus.OK)
    travel = np.array([0.4] * 3 + [0.1] * 3)
    # the second stop is a spring under a constant wrench: 3.5 N m and 7 N
    soft = np.array([5e-3 * 3.5] * 3 + [5e-4 * 7.0] * 3)
    assert np.abs(trials.travelled[:, -1, free] - (travel + soft)[free]).max() < 2e-3
    assert np.abs(trials.travelled[..., ~free]).max() < 1e-4
    assert np.all(trials.reaction[..., free] == 0)
    np.testing.assert_allclose(
        trials.peak_force, np.linalg.norm(trials.reaction[..., 3:], axis=-1).max(axis=1), rtol=1e-12
    )


@pytest.mark.parametrize("name", ["hybrid", "impedance"])
@pytest.mark.parametrize("label", ["A", "B", "I"])
def test_other_controllers_reach_the_stops_more_gently(label: str, name: str) -> None:
    truth = batch(label)
    gentle = run(truth, truth, controller=CONTROLLERS[name])
    rough = run(truth, truth)
    assert np.all(gentle.completed)
    assert np.all(gentle.peak_force < rough.peak_force)


def test_hybrid_control_keeps_its_speed() -> None:
    truth = batch("B")
    trials = run(truth, truth, controller=reproduction.hybrid(speed=(0.3, 0.08)))
    made = trials.travelled[0, :, 3]
    pace = np.diff(made)[10:20] / 0.05
    # the mechanism's friction of 40 N s/m against a gain of 120
    np.testing.assert_allclose(pace, 0.08 * 120 / 160, rtol=0.05)


def test_wrench_in_a_turned_frame_reacts_by_the_sine() -> None:
    """A moment about an axis 10 degrees off: at rest, M sin(10 deg) about the constrained axes."""
    truth = batch("A")
    angle = np.radians(10)
    turned = frame_arrays(truth)
    tilt = jnp.asarray([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    turned = replace(turned, angular_axes=turned.angular_axes @ tilt)
    trials = run(truth, turned)
    at_rest = np.linalg.norm(trials.reaction[:, -1, :3], axis=-1)
    np.testing.assert_allclose(at_rest, 3.5 * np.cos(angle) * np.sin(angle), rtol=0.02)


def test_force_at_a_shifted_point_reacts_by_the_lever() -> None:
    """A force of 7 N, 5 cm off: 0.35 N m about a constrained axis, at rest."""
    truth = batch("B")
    shifted = replace(frame_arrays(truth), position=frame_arrays(truth).position.at[:, 2].add(0.05))
    straight, trials = run(truth, truth), run(truth, shifted)
    more = np.linalg.norm((trials.reaction - straight.reaction)[:, -1, :3], axis=-1)
    np.testing.assert_allclose(more, 0.35, rtol=0.02)


def test_softer_mounts_give_way() -> None:
    truth = batch("A")
    trials = run(truth, truth, compliance=(3e-3, 1e-4))
    held = np.abs(trials.travelled[..., [0, 2, 3, 4, 5]]).max()
    assert 1e-4 < held < 2e-2
    assert np.all(trials.completed)


def test_errors_have_the_size_asked_for() -> None:
    truth = jax.tree.map(lambda leaf: leaf + 0.3 * jax.random.normal(KEY, leaf.shape, leaf.dtype), batch("K"))
    wrong = erroneous_frames(truth, KEY, angles=(2.0, 2.0), distances=(4.0, 4.0))
    right = frame_arrays(truth)
    pose = panda.forward_kinematics(jnp.asarray(reproduction.ROOMY))

    def located(frame: Any) -> tuple[jax.Array, jax.Array]:
        there = locate(frame, *pose)
        return there.linear_axes, there.lever

    axes, origin = jax.vmap(located)(right)
    wrong_axes, wrong_origin = jax.vmap(located)(frame_arrays(wrong))
    np.testing.assert_allclose(jnp.linalg.norm(wrong_origin - origin, axis=-1), 4e-3, rtol=1e-9)
    trace = jnp.trace(jnp.swapaxes(axes, -1, -2) @ wrong_axes, axis1=-2, axis2=-1)
    np.testing.assert_allclose(jnp.degrees(jnp.arccos((trace - 1) / 2)), 2.0, rtol=1e-6)


@pytest.mark.parametrize("label", ["A", "B", "I"])
def test_from_demonstration_to_reproduction(label: str) -> None:
    made = jax.device_get(reproduction.compare(label, KEY, TRIALS))
    assert list(made.rows) == ["exact", "identified"]
    for trials in made.rows.values():
        assert np.all(trials.completed)
    moment, force = made.excess()
    assert np.abs(np.median(moment)) < 1.0
    assert np.abs(np.median(force)) < 2.0
    angular, linear, position = np.median(made.errors, axis=0)
    assert np.isnan(angular) == (label == "B")
    assert np.isnan(linear) == (label == "A")
    assert np.isnan(position) == (label == "B")
    np.testing.assert_array_equal(
        made.found.linear.dof.sum(axis=-1), sum(made.demonstrations.truth.linear_dof)
    )


def test_identified_frames_of_different_types() -> None:
    """Frames of a batch may differ in type; each is what its constraint frame is."""
    made = panda.demonstrate("I", KEY, batch=TRIALS, spread=panda.SPREAD, imperfections=panda.REALISTIC)
    found = rf.identify(made.poses, times=made.times)
    found = replace(found, linear=replace(found.linear, type_code=found.linear.type_code.at[0].set(2)))
    frames = reproduction.control_frames(found)
    for i in range(2):
        expected = frame_arrays(found[i].constraint_frame)
        for got, want in zip(
            jax.tree.leaves(jax.tree.map(lambda leaf, i=i: leaf[i], frames)),
            jax.tree.leaves(expected),
            strict=True,
        ):
            np.testing.assert_allclose(got, want, atol=1e-12)


def test_tasks_out_of_reach_are_told_apart_and_left_out() -> None:
    """From the arm's home, number 0 of this key stretches the arm out before the stop, whatever the frame."""
    key, home = jax.random.key(77), panda.PANDA.home
    made = panda.demonstrate(
        "H", jax.random.split(key)[0], batch=TRIALS, spread=panda.SPREAD, imperfections=panda.REALISTIC
    )
    trials = run(made.truth, made.truth, compliance=(2.5e-3, 1e-4), start=home)
    assert not trials[0].completed
    np.testing.assert_array_equal(trials.status_code == panda.RolloutStatus.SINGULAR, ~trials.completed)
    compared = jax.device_get(reproduction.compare("H", key, TRIALS, start=home))
    assert compared.redrawn >= 1
    assert all(np.all(rows.completed) for rows in compared.rows.values())
    np.testing.assert_array_equal(compared.exact.poses[0], trials.poses[1])
    roomy = jax.device_get(reproduction.compare("H", key, TRIALS))
    assert roomy.redrawn == 0


def test_bad_input() -> None:
    truth = batch("A")
    with pytest.raises(ValueError, match="trials must be at least 1"):
        reproduction.compare("A", KEY, 0)
    with pytest.raises(ValueError, match=r"Expected Imperfections\(...\)"):
        reproduction.compare("A", KEY, imperfections="realistic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one control frame per constraint"):
        reproduction.reproduce(truth, jax.tree.map(lambda leaf: leaf[:2], truth))
    with pytest.raises(ValueError, match="choose from panda, fr3"):
        reproduction.reproduce(truth, truth, arm="kuka")
