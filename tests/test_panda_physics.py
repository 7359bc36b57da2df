"""The arm's motion under a constraint: against C MuJoCo, wrenches, energy, steps and derivatives."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks.mechanism import mechanism_joints, mechanism_model, weld
from reframe_jax.constraints.frame import frame_arrays, ground_twist, locate, slip, twist_map
from reframe_jax.geometry import transforms
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation.arm import demonstration, guide
from reframe_jax.simulation.arm.guide import EXCITATIONS, demonstration_keys, guide_drive
from reframe_jax.simulation.arm.rollout import Steps, hold, integrate

KEY = jax.random.key(11)
LABELS = list(rf.CONSTRAINTS)


def test_maps_of_a_frame_agree(rng: np.random.Generator) -> None:
    """The slip between two near poses is the twist map's velocity times the time."""
    for label in LABELS:
        frame = frame_arrays(rf.ConstraintFrame.named(label, rotvec=rng.normal(size=3)))
        pose = transforms.pose_exp(jnp.asarray(rng.normal(size=6)))
        body = jnp.asarray(rng.normal(size=6))
        h = 1e-5
        ends = [locate(frame, *split(pose @ transforms.pose_exp(s * h * body))) for s in (-0.5, 0.5)]
        here = locate(frame, *split(pose))
        spatial = jnp.concatenate([pose[:3, :3] @ body[:3], pose[:3, :3] @ body[3:]])
        velocity = twist_map(here) @ spatial
        np.testing.assert_allclose(slip(*ends) / h, velocity, atol=1e-8)
        np.testing.assert_allclose(ground_twist(here, velocity), spatial, atol=1e-12)


def test_frames_move_as_their_type_says(rng: np.random.Generator) -> None:
    """Axes turn with the body of the first letter, the origin moves with that of the second."""
    pose = transforms.pose_exp(jnp.asarray(rng.normal(size=6)))
    rotation, position = split(pose)
    seen = set()
    for label in LABELS:
        frame = rf.ConstraintFrame.named(label, position=rng.normal(size=3), rotvec=rng.normal(size=3))
        there = locate(frame_arrays(frame), rotation, position)
        turning, axes, origin = frame.angular_type.name, *frame.linear_type.name
        seen.add(axes + origin)
        moved = {"G": np.eye(3), "B": np.asarray(rotation)}
        np.testing.assert_allclose(there.angular_axes, moved[turning] @ frame.angular_axes, atol=1e-12)
        np.testing.assert_allclose(there.linear_axes, moved[axes] @ frame.linear_axes, atol=1e-12)
        place = position + rotation @ frame.position if origin == "B" else frame.position
        np.testing.assert_allclose(position + there.lever, place, atol=1e-12)
    assert seen == {"GB", "BG", "GG", "BB"}


def test_hand_pulls_beside_the_place_and_shakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tool at rest where it should be feels a constant pull aside, and a tremor, of the sizes given."""
    frame = frame_arrays(panda.frame_on_arm("B"))
    rotation, position = panda.forward_kinematics(jnp.asarray(panda.PANDA.home))
    still = panda.Motion(jnp.zeros(6), rotation, position, jnp.eye(6), jnp.eye(6), jnp.zeros(6))
    pose = transforms.make_pose(rotation, position)
    times = jnp.arange(1.0, 21.0, 0.1)

    def wrenches() -> np.ndarray:
        def felt(key: jax.Array) -> jax.Array:
            drive = guide_drive(key, frame, lambda t: (0 * t * jnp.ones(3),) * 2, 0.01)
            return jax.vmap(lambda t: drive(pose, t, still)[1])(times)

        return np.asarray(jax.jit(jax.vmap(felt))(jax.random.split(KEY, 400)))

    with monkeypatch.context() as patch:
        patch.setattr(guide, "_MISALIGNMENT", (0.0, 0.0))
        shaken = wrenches()
    np.testing.assert_allclose(shaken.std(axis=(0, 1)), [0.4] * 3 + [1.5] * 3, rtol=0.05)
    monkeypatch.setattr(guide, "_TREMOR", (0.0, 0.0))
    pulled = wrenches()
    assert np.abs(np.ptp(pulled, axis=1)).max() < 1e-9
    np.testing.assert_allclose(pulled[:, 0].std(axis=0), [20 * 0.02] * 3 + [400 * 0.003] * 3, rtol=0.15)


def split(pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    return pose[:3, :3], pose[:3, 3]


@pytest.mark.parametrize(
    ("label", "kinds"),
    [("A", "h"), ("B", "s"), ("C", "sh"), ("D", "ssh"), ("I", "sh"), ("J", "hs"), ("K", "ssb"), ("L", "bss")],
)
def test_mechanisms(label: str, kinds: str) -> None:
    joints = mechanism_joints(rf.ConstraintFrame.named(label))
    assert "".join(kind[0] for kind, _ in joints) == kinds


@pytest.mark.parametrize("label", list("EFGH"))
def test_contours_have_no_mechanism(label: str) -> None:
    with pytest.raises(ValueError, match="No mechanism makes"):
        mechanism_joints(rf.ConstraintFrame.named(label))


def test_wrench_returns_and_energy_is_kept() -> None:
    """A wrench along constrained axes comes back as its negative; one along free axes does work."""
    frame = frame_arrays(panda.frame_on_arm("C"))
    start = jnp.asarray(panda.PANDA.home)
    step, count = 0.001, 500

    def drive(wrench: jax.Array, t: jax.Array, motion: Any) -> tuple[jax.Array, jax.Array]:
        rise = jnp.minimum(t / 0.3, 1)
        there = locate(frame, motion.rotation, motion.position)
        return wrench, motion.jacobian.T @ (twist_map(there).T @ (rise * wrench))

    @jax.jit
    @jax.vmap
    def run(wrench: jax.Array) -> tuple[Any, jax.Array]:
        track = integrate(
            panda.PANDA,
            frame,
            start,
            drive,
            wrench,
            lambda slipped: hold(frame.free, slipped, step, jnp.zeros(6)),
            Steps(samples=count, substeps=1, length=step),
        )
        # the force acts over a step, from the middle of the one before to the middle of this one
        motion = panda.arm_motion(track.joints[-1], track.velocity[-1])
        return track, motion.velocity @ motion.mass @ motion.velocity / 2

    held = jnp.array([0, 0.5, -0.3, 0, 6.0, 4.0])
    pushed = jnp.array([0.4, 0, 0, 3.0, 0, 0])
    track, kinetic = run(jnp.stack([held, pushed]))
    np.testing.assert_allclose(track.force[0, -1], -held, rtol=0.01)
    assert np.abs(track.slip[0]).max() < 1e-4
    rise = np.minimum((np.arange(count) + 0.5) * step / 0.3, 1)
    work = np.sum(rise[:, None] * np.diff(track.slip[1], axis=0) * np.asarray(pushed))
    lost = step * np.sum(np.asarray(track.velocity[1, 1:]) ** 2 @ panda.PANDA.damping)
    np.testing.assert_allclose(work, kinetic[1] + lost, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("label", list("ABCDIJKL"))
def test_mechanism_and_exact_form_agree(label: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same hand guides the arm in C MuJoCo, where the tool is welded to joints."""
    step, count = 0.0025, 800
    monkeypatch.setattr(demonstration, "_LONGEST", step)
    exact = panda.demonstrate(label, KEY, spread=panda.SPREAD, duration=step * count)
    truth = jax.tree.map(lambda leaf: leaf[0], exact.truth)
    frame, home = frame_arrays(truth), jnp.asarray(panda.PANDA.home)
    _, hand_key, excitation_key, _ = demonstration_keys(KEY, jnp.zeros(1, jnp.uint32))[0]
    excitation = EXCITATIONS["exciting"](excitation_key, frame.free)
    drive = guide_drive(hand_key, frame, excitation, step)

    @jax.jit
    def advance(pose: jax.Array, t: float, joints: jax.Array, velocity: jax.Array) -> Any:
        return drive(pose, t, panda.arm_motion(joints, velocity))

    model = mechanism_model(panda.PANDA, mechanism_joints(truth), step)
    data = weld(model, truth, home, panda.PANDA)
    pose, poses, gap = exact.exact_poses[0, 0], [], 0.0
    for number in range(count):
        pose, torque = advance(pose, (number + 0.5) * step, data.qpos[:7], data.qvel[:7])
        data.qfrc_applied[:7] = torque
        mujoco.mj_step(model, data)
        gap = max(gap, np.linalg.norm(data.site("tcp").xpos - data.site("grip").xpos))
        poses.append(data.qpos[:7].copy())
    welded = transforms.make_pose(*panda.forward_kinematics(jnp.asarray(poses[19::20])))
    np.testing.assert_allclose(welded, exact.exact_poses[0, 1:], atol=5e-3)
    assert gap < 100e-6


@pytest.mark.slow
def test_batch_size_and_step_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    many = panda.demonstrate("K", KEY, batch=5, duration=2.0)
    one = panda.demonstrate("K", KEY, batch=1, first=4, duration=2.0)
    np.testing.assert_allclose(one.poses[0], many.poses[4], atol=1e-9)
    positions = []
    for step in (0.01, 0.005, 0.0025):
        monkeypatch.setattr(demonstration, "_LONGEST", step)
        positions.append(panda.demonstrate("K", KEY, batch=5, duration=2.0).exact_poses[..., :3, 3])
    coarse, fine = (np.abs(a - b).max() for a, b in pairwise(positions))
    assert coarse < 1.5e-3
    assert fine < 0.7 * coarse


@pytest.mark.slow
def test_single_precision() -> None:
    made = jax.device_get(
        panda.demonstrate(
            jax.tree.map(lambda leaf: leaf.astype(jnp.float32), panda.frame_on_arm("K")), KEY, batch=4
        )
    )
    assert made.poses.dtype == np.float32
    assert made.violation[:, 1].max() < 50e-6


@pytest.mark.slow
def test_gradient_is_the_finite_difference() -> None:
    """Reverse mode, of a geometry."""
    frame = panda.frame_on_arm("K")

    @jax.jit
    def height(offset: jax.Array) -> jax.Array:
        made = panda.demonstrate(replace(frame, position=frame.position + offset), KEY, duration=0.5)
        return jnp.sum(made.exact_poses[0, -1, :3, 3])

    slope = jax.grad(height)(jnp.zeros(3))
    for axis in range(3):
        h = 1e-5 * jnp.eye(3)[axis]
        difference = (height(h) - height(-h)) / 2e-5
        np.testing.assert_allclose(slope[axis], difference, rtol=1e-3, atol=1e-7)
