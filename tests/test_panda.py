"""Demonstrations: constraints kept, recordings as imperfect as asked, identifications right."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax import metrics, panda, transforms
from reframe_jax.panda.compiled import compiled
from reframe_jax.panda.constraint import body_twist, frame_arrays, locate, slip, twist_map
from reframe_jax.panda.mechanism import mechanism_joints
from reframe_jax.panda.rollout import Steps, hold, integrate

BATCH = 8  # one compiled program for this module
KEY = jax.random.key(11)
LABELS = list(rf.CONSTRAINTS)


def demonstrate(label: str, **options: Any) -> panda.Demonstration:
    return jax.device_get(panda.demonstrate(label, KEY, batch=BATCH, spread=panda.SPREAD, **options))


@pytest.fixture(scope="module")
def rigid() -> dict[str, panda.Demonstration]:
    """Demonstrations of all twelve constraints on a perfect robot."""
    return {label: demonstrate(label) for label in LABELS}


def usable(made: panda.Demonstration) -> np.ndarray:
    good = np.flatnonzero(made.status_code == panda.RolloutStatus.OK)
    assert len(good) > BATCH / 2
    return good


def test_shapes(rigid: dict[str, panda.Demonstration]) -> None:
    made = rigid["K"]
    assert made.times.shape == (101,)
    assert made.poses.shape == made.exact_poses.shape == (BATCH, 101, 4, 4)
    assert made.joint_positions.shape == made.joint_velocities.shape == (BATCH, 101, 7)
    assert made.reaction.shape == made.slip.shape == (BATCH, 101, 6)
    assert made.truth.position.shape == (BATCH, 3)
    assert made[0].poses.shape == (101, 4, 4)
    assert made[0].status == panda.RolloutStatus.OK
    np.testing.assert_array_equal(made.poses, made.exact_poses)


@pytest.mark.parametrize("label", LABELS)
def test_constraint_is_kept(rigid: dict[str, panda.Demonstration], label: str) -> None:
    angle, distance = np.max(rigid[label].violation[usable(rigid[label])], axis=0)
    assert angle < 0.5e-3
    assert distance < 50e-6


@pytest.mark.parametrize("label", LABELS)
def test_free_axes_move_and_reactions_act_on_the_others(
    rigid: dict[str, panda.Demonstration], label: str
) -> None:
    made = rigid[label]
    free = np.array((*made.truth.angular_dof, *made.truth.linear_dof), dtype=bool)
    travel = np.ptp(made.slip, axis=1)
    assert np.all(travel[:, :3][:, free[:3]] > 0.15)
    assert np.all(travel[:, 3:][:, free[3:]] > 0.04)
    assert np.all(made.reaction[..., free] == 0)
    assert np.all(np.abs(made.reaction[:, 1:, ~free]).max(axis=1) > 1e-2)


def test_violation_agrees_with_the_poses(rigid: dict[str, panda.Demonstration]) -> None:
    """What has an integral is measured from the poses alone: fixed points, planes and axes."""

    def origins(made: panda.Demonstration, on_body: bool) -> np.ndarray:
        rotation, position = made.exact_poses[..., :3, :3], made.exact_poses[..., :3, 3]
        origin = made.truth.position[:, None]
        if on_body:
            return position + np.einsum("nkij,nlj->nki", rotation, origin)
        return np.einsum("nkji,nkj->nki", rotation, origin - position)

    def along(made: panda.Demonstration, path: np.ndarray, axes: list[int]) -> float:
        frames = np.asarray(made.truth.linear_axes)
        moved = np.einsum("nij,nki->nkj", frames, path - path[:, :1])
        return float(np.abs(moved[usable(made)][..., axes]).max())

    assert along(rigid["A"], origins(rigid["A"], on_body=True), [0, 1, 2]) < 50e-6
    assert along(rigid["K"], origins(rigid["K"], on_body=True), [2]) < 50e-6
    assert along(rigid["L"], origins(rigid["L"], on_body=False), [2]) < 50e-6
    assert along(rigid["I"], origins(rigid["I"], on_body=True), [1, 2]) < 50e-6
    assert along(rigid["J"], origins(rigid["J"], on_body=False), [1, 2]) < 50e-6
    turned = rigid["B"].exact_poses[..., :3, :3] - rigid["B"].exact_poses[:, :1, :3, :3]
    assert np.abs(turned).max() < 0.5e-3
    for label, axis in (("A", 1), ("C", 0), ("D", 2), ("E", 1), ("F", 1), ("I", 1), ("J", 1)):
        made = rigid[label]
        in_body = np.asarray(made.truth.angular_axes)[:, :, axis]
        if made.truth.angular_type == rf.AngularType.G:
            in_body = np.einsum("nji,nj->ni", made.exact_poses[:, 0, :3, :3], in_body)
        axes = np.einsum("nkij,nj->nki", made.exact_poses[..., :3, :3], in_body)
        assert np.abs(axes - axes[:, :1])[usable(made)].max() < 0.5e-3


@pytest.mark.parametrize("label", LABELS)
def test_identified_at_encoder_grade(label: str) -> None:
    made = demonstrate(label, imperfections=panda.ENCODER_GRADE)
    good = usable(made)
    assert 1e-7 < np.abs(made.poses - made.exact_poses).max() < 1e-3
    # all of them, for the sake of one compiled shape
    found = rf.identify(made.poses, times=made.times)
    start = jnp.asarray(made.exact_poses[:, 0])
    errors = metrics.geometry_errors(found, made.truth, start=start)
    assert np.all(metrics.types_correct(found, made.truth, ties=True)[good])
    assert np.all(metrics.dof_correct(found, made.truth)[good])
    for error, bound in ((errors.angular, 0.1), (errors.linear, 0.1)):
        assert np.all(np.isnan(error)) or np.degrees(np.median(error[good])) < bound
    assert np.all(np.isnan(errors.position)) or np.median(errors.position[good]) < 0.5e-3


def test_realistic_compliance_gives_way(rigid: dict[str, panda.Demonstration]) -> None:
    made = demonstrate("K", imperfections=panda.REALISTIC)
    force, slipped = made.reaction[..., 5], made.slip[..., 5]
    assert 1e-4 < np.abs(slipped).max() < 5e-3
    # the spring is a damped one: the two go together, but not exactly
    assert np.corrcoef(force.ravel(), -slipped.ravel())[0, 1] > 0.8
    assert np.all(made.status_code == rigid["K"].status_code)


@pytest.mark.slow
@pytest.mark.parametrize("label", LABELS)
def test_errors_are_the_papers_where_the_rms_is(label: str) -> None:
    """Moved as fast as in Table 4 of the paper, and giving way as much."""
    options = {"chunk": 32, "spread": panda.SPREAD, "excitation": "brisk", "imperfections": panda.MATCHED}
    parts = list(panda.demonstrations(label, KEY, 20, **options))
    poses = np.concatenate([part.poses for part in parts])
    truth = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(part.truth for part in parts))
    found = rf.identify(poses, times=parts[0].times)
    start = jnp.asarray(np.concatenate([part.exact_poses[:, 0] for part in parts]))
    errors = metrics.geometry_errors(found, truth, start=start)
    assert np.all(metrics.types_correct(found, truth, ties=True))
    assert np.all(metrics.dof_correct(found, truth))
    bounds = ((errors.angular, np.radians(1)), (errors.linear, np.radians(2.5)), (errors.position, 8e-3))
    for error, bound in bounds:
        assert np.all(np.isnan(error)) or np.median(error) < bound
    held = {0: 3, 1: 2, 3: 0}[sum(truth.angular_dof)]
    rms = np.median(found.angular.rms, axis=0)
    assert np.all((rms[:held] > 20e-3) & (rms[:held] < 65e-3))
    if held == 2:
        assert 0.65 < rms[2] < 0.95


def test_number_of_a_key_is_one_demonstration(rigid: dict[str, panda.Demonstration]) -> None:
    later = demonstrate("E", first=3)
    np.testing.assert_allclose(later.poses[0], rigid["E"].poses[3], atol=1e-12)
    np.testing.assert_allclose(later.truth.position[0], rigid["E"].truth.position[3], atol=1e-15)
    assert np.all(np.abs(later.poses[1] - later.poses[0]).max() > 1e-3)


def test_imperfections_one_by_one(rigid: dict[str, panda.Demonstration]) -> None:
    """Each is off by default and does what it says; none but compliance changes the motion."""
    exact = rigid["C"]

    def recorded(**options: float) -> np.ndarray:
        made = demonstrate("C", imperfections=panda.Imperfections(**options))
        np.testing.assert_array_equal(made.exact_poses, exact.exact_poses)
        return made.poses

    def off(poses: np.ndarray) -> np.ndarray:
        return np.linalg.norm(poses[..., :3, 3] - exact.exact_poses[..., :3, 3], axis=-1)

    assert 0.2e-3 < off(recorded(encoder_noise=1e-3)).mean() < 3e-3
    assert 1e-5 < off(recorded(encoder_step=1e-4)).mean() < 1e-4
    assert 1e-4 < off(recorded(backlash=1e-3)).max() < 2e-3
    noisy = recorded(pose_noise=1e-3)
    assert abs(np.std((noisy - exact.exact_poses)[..., :3, 3]) / 1e-3 - 1) < 0.1
    # the tool hangs near a half turn, where a change of the rotation vector turns by 2/pi as much
    turn = transforms.pose_log(jnp.asarray(np.linalg.inv(exact.exact_poses) @ noisy))[..., :3]
    assert 2 / np.pi < np.std(turn) / 3e-3 < 1
    # a robot that is built differently is wrong by about the same everywhere
    built = off(recorded(calibration=1e-3))
    assert 0.5e-3 < built.mean() < 6e-3
    assert np.all(np.ptp(built, axis=1) < 0.5 * built.mean())
    assert 1e-4 < off(recorded(angular_calibration=1e-3)).mean() < 5e-3
    late = recorded(latency=0.05)
    np.testing.assert_array_equal(late[..., :3, 3], exact.exact_poses[..., :3, 3])
    np.testing.assert_allclose(late[:, 1:, :3, :3], exact.exact_poses[:, :-1, :3, :3], atol=1e-12)
    lost = recorded(dropouts=0.25)
    repeated = np.all(lost[:, 1:] == lost[:, :-1], axis=(2, 3))
    assert 0.15 < repeated.mean() < 0.35
    np.testing.assert_array_equal(lost[:, 1:][~repeated], exact.exact_poses[:, 1:][~repeated])


def test_status_tells_of_joint_limits() -> None:
    """A prismatic joint that is pushed far out of reach."""
    far = jax.device_get(
        panda.demonstrate("B", KEY, batch=BATCH, guide=panda.Guide(misalignment=3.0, stiffness=100.0))
    )
    assert np.any(far.status_code == panda.RolloutStatus.JOINT_LIMIT)
    assert np.all((far.limit_margin < 0) <= (far.status_code >= panda.RolloutStatus.JOINT_LIMIT))


def test_demonstrations_come_in_chunks_and_only_good_ones() -> None:
    seen: list[tuple[int, int]] = []
    parts = list(
        panda.demonstrations(
            "K", KEY, 12, chunk=BATCH, spread=panda.SPREAD, progress=lambda *done: seen.append(done)
        )
    )
    assert sum(len(part.poses) for part in parts) == 12
    assert all(np.all(part.status_code == panda.RolloutStatus.OK) for part in parts)
    assert seen[-1] == (12, 12)


def test_stored_demonstrations_go_on_where_they_stopped(tmp_path: Path) -> None:
    options = {"chunk": BATCH, "spread": panda.SPREAD}
    folder = panda.store_demonstrations("K", KEY, 4, tmp_path / "demos", **options)
    first = folder / "part-00000000.npz"
    written = first.stat().st_mtime_ns
    panda.store_demonstrations("K", KEY, 12, folder, **options)
    assert first.stat().st_mtime_ns == written
    made = panda.load_demonstrations(folder, 12)
    drawn = list(panda.demonstrations("K", KEY, 12, **options))
    np.testing.assert_array_equal(made.poses, np.concatenate([part.poses for part in drawn]))
    assert made.truth.linear_type == rf.LinearType.GB
    assert made[3].truth.position.shape == (3,)
    with pytest.raises(ValueError, match="other options"):
        panda.store_demonstrations("I", KEY, 12, folder, **options)
    with pytest.raises(ValueError, match="no demonstrations"):
        panda.load_demonstrations(tmp_path)
    with pytest.raises(ValueError, match="fewer than 99"):
        panda.load_demonstrations(folder, 99)


def test_demonstrations_that_cannot_be_made() -> None:
    guide = panda.Guide(misalignment=30.0, stiffness=1000.0)
    with pytest.raises(ValueError, match="are usable"):
        list(panda.demonstrations("B", KEY, 64, chunk=BATCH, guide=guide))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"arm": "kuka"}, "There are: panda, fr3"),
        ({"excitation": "wild"}, "There are: exciting, brisk, paper"),
        ({"batch": 0}, "batch must be at least 1"),
        ({"step": 0.03}, "must divide"),
        ({"duration": 0.01}, "step <= dt <= duration"),
        ({"start": np.zeros(6)}, r"start must have shape \(7,\)"),
        ({"form": "rope"}, "must be 'exact' or 'mechanism'"),
    ],
)
def test_bad_input(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        panda.demonstrate("A", KEY, **options)


def test_unknown_constraint() -> None:
    with pytest.raises(KeyError, match="Revolute joint"):
        panda.demonstrate("Z", KEY)


def test_geometry_of_another_batch() -> None:
    frame = rf.ConstraintFrame.named("A", position=np.zeros((3, 3)), rotvec=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"must have shape \(3,\) or \(2, 3\)"):
        panda.demonstrate(frame, KEY, batch=2)


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
        np.testing.assert_allclose(body_twist(here, velocity), spatial, atol=1e-12)


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
        panda.demonstrate(label, KEY, form="mechanism")


def test_wrench_returns_and_energy_is_kept() -> None:
    """A wrench along constrained axes comes back as its negative; one along free axes does work."""
    frame = frame_arrays(panda.frame_on_arm("C"))
    start = jnp.asarray(panda.PANDA.home)
    step, count = 0.001, 500

    def drive(wrench: jax.Array, t: jax.Array, motion: Any, located: Any) -> tuple[jax.Array, jax.Array]:
        rise = jnp.minimum(t / 0.3, 1)
        return wrench, motion.jacobian.T @ (twist_map(located).T @ (rise * wrench))

    @compiled(())
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
@pytest.mark.parametrize("label", ["A", "I", "J", "K"])
def test_mechanism_and_exact_form_agree(label: str) -> None:
    options = {"batch": 4, "step": 0.005, "spread": panda.SPREAD, "duration": 2.0}
    exact = panda.demonstrate(label, KEY, **options)
    welded = panda.demonstrate(label, KEY, form="mechanism", **options)
    np.testing.assert_allclose(welded.exact_poses, exact.exact_poses, atol=5e-3)
    assert np.max(welded.violation) < 1e-3
    away = np.sqrt(np.mean((welded.reaction - exact.reaction) ** 2))
    assert away < 0.05 * np.sqrt(np.mean(np.square(exact.reaction))) + 0.05


@pytest.mark.slow
def test_batch_size_and_step_do_not_matter() -> None:
    many = panda.demonstrate("K", KEY, batch=5, duration=2.0)
    one = panda.demonstrate("K", KEY, batch=1, first=4, duration=2.0)
    np.testing.assert_allclose(one.poses[0], many.poses[4], atol=1e-9)
    positions = [
        panda.demonstrate("K", KEY, batch=5, duration=2.0, step=step).exact_poses[..., :3, 3]
        for step in (0.01, 0.005, 0.0025)
    ]
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
    """Reverse mode, of a geometry and of the guide's stiffness."""
    frame = panda.frame_on_arm("K")

    @jax.jit
    def height(offset: jax.Array, stiffness: jax.Array) -> jax.Array:
        from dataclasses import replace

        made = panda.demonstrate(
            replace(frame, position=frame.position + offset),
            KEY,
            duration=0.5,
            guide=panda.Guide(stiffness=stiffness),
        )
        return jnp.sum(made.exact_poses[0, -1, :3, 3])

    point = jnp.zeros(3), jnp.asarray(400.0)
    slope = jax.grad(height, argnums=(0, 1))(*point)
    for axis in range(3):
        h = 1e-5 * jnp.eye(3)[axis]
        difference = (height(h, point[1]) - height(-h, point[1])) / 2e-5
        np.testing.assert_allclose(slope[0][axis], difference, rtol=1e-3, atol=1e-7)
    difference = (height(point[0], point[1] + 0.1) - height(point[0], point[1] - 0.1)) / 0.2
    np.testing.assert_allclose(slope[1], difference, rtol=1e-3, atol=1e-9)
