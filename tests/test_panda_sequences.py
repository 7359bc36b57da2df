"""The arm demonstrates tasks that change constraints: approach, contact, motion, release."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.constraints.frame import body_twist, frame_arrays
from reframe_jax.simulation import arm as panda

BATCH = 8  # with the usual duration and sample time, the program of test_panda.py
KEY = jax.random.key(11)
TASK = ("unconstrained", "D", "unconstrained")


@pytest.fixture(scope="module")
def made() -> panda.SequenceDemonstration:
    """A flat tool meets a board in motion, wipes it for 4 s, and lifts off in as long as it came."""
    return jax.device_get(
        panda.demonstrate_sequence(
            TASK,
            KEY,
            batch=BATCH,
            durations=[5.0, 4.0, 5.0],
            pause=False,
            spread=panda.SPREAD,
            imperfections=panda.ENCODER_GRADE,
        )
    )


def usable(made: panda.SequenceDemonstration) -> np.ndarray:
    good = np.flatnonzero(made.status_code == panda.RolloutStatus.OK)
    assert len(good) >= BATCH / 2
    return good


def test_stages_join_where_they_say(made: panda.SequenceDemonstration) -> None:
    assert made.boundaries == (100, 180)
    assert made.poses.shape == made.exact_poses.shape == (BATCH, 281, 4, 4)
    assert made.joint_positions.shape == (BATCH, 281, 7)
    np.testing.assert_allclose(np.diff(made.times), 0.05)
    for before, after, index in zip(made.stages[:-1], made.stages[1:], made.boundaries, strict=True):
        np.testing.assert_array_equal(before.joint_positions[:, -1], after.joint_positions[:, 0])
        np.testing.assert_array_equal(before.exact_poses[:, -1], made.exact_poses[:, index])
        np.testing.assert_array_equal(before.poses[:, -1], after.poses[:, 0])
    # encoders: of the true poses the recording shows all but tens of micrometres
    assert np.abs(made.poses - made.exact_poses).max() < 2e-4
    assert made[2].poses.shape == (281, 4, 4)
    assert made[2].stages[1].truth.position.shape == (3,)


def test_each_constraint_holds_in_its_stage(made: panda.SequenceDemonstration) -> None:
    good = usable(made)
    turned, moved = np.asarray(made[good].stages[1].violation).T
    assert turned.max() < 5e-4
    assert moved.max() < 5e-5
    # the tool tilts freely, but not on the board
    tilted = [np.asarray([tilt(stage[i], made.stages[1].truth, i) for i in good]) for stage in made.stages]
    assert tilted[1].max() < 1e-3
    assert min(tilted[0].min(), tilted[2].min()) > 0.05


def tilt(made: panda.Demonstration, board: rf.ConstraintFrame, number: int) -> float:
    """How far the normal of a board, as the body sees it, turns in a demonstration, rad."""
    assert board.angular_type == rf.AngularType.B
    normal = np.asarray(made.exact_poses)[:, :3, :3] @ np.asarray(board.angular_axes[number])[:, 2]
    return float(np.linalg.norm(np.ptp(normal, axis=0)))


def test_contact_is_made_in_motion_and_only_free_motion_survives(made: panda.SequenceDemonstration) -> None:
    before, after = made.stages[:2]
    jacobian_at = jax.jit(lambda q: panda.arm_motion(q, jnp.zeros(7)).jacobian)
    for i in usable(made):
        jacobian = jacobian_at(np.asarray(before.joint_positions[i, -1]))
        speeds = [
            np.asarray(jacobian @ v) for v in (before.joint_velocities[i, -1], after.joint_velocities[i, 0])
        ]
        assert np.linalg.norm(speeds[0] - speeds[1]) > 1e-3
        # the second is a motion that the constraint allows: the frame's axes explain all of it
        pose = np.asarray(before.exact_poses[i, -1])
        own = jax.tree.map(lambda leaf, i=i: leaf[i], after.truth)
        free = np.flatnonzero(np.asarray(frame_arrays(own).free))
        rotation = pose[:3, :3]
        basis = np.stack(
            [
                np.asarray(body_twist(frame_arrays(own), rotation, pose[:3, 3], axis))
                for axis in np.eye(6)[free]
            ]
        ).T
        twist = np.concatenate([rotation.T @ speeds[1][:3], rotation.T @ speeds[1][3:]])
        left = twist - basis @ np.linalg.lstsq(basis, twist, rcond=None)[0]
        assert np.abs(left).max() < 1e-9


def test_segment_finds_the_stages(made: panda.SequenceDemonstration) -> None:
    names = ["Unconstrained", rf.CONSTRAINTS["D"].name, "Unconstrained"]
    for i in usable(made)[:3]:
        found = rf.segment(made.poses[i], times=made.times)
        assert [segment.name for segment in found.segments] == names
        assert np.all(np.abs(np.subtract([b.index for b in found.boundaries], made.boundaries)) <= 2)


def test_the_hand_pauses_at_changes() -> None:
    options = {"batch": BATCH, "spread": panda.SPREAD}
    paused = jax.device_get(panda.demonstrate_sequence(["unconstrained", "A"], KEY, **options))
    poses = paused.exact_poses[usable(paused)]
    speed = np.linalg.norm(np.diff(poses[..., :3, 3], axis=1), axis=-1)
    assert np.all(speed[:, 98:100].max(axis=1) < 0.2 * speed.max(axis=1))
    # numbers go on where an earlier batch ended
    later = panda.demonstrate_sequence(["unconstrained", "A"], KEY, first=3, **options)
    np.testing.assert_allclose(later.exact_poses[0], paused.exact_poses[3], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"durations": [1.0]}, "3 constraints and 1 durations"),
        ({"batch": 0}, "batch must be at least 1"),
        ({"start": np.zeros(6)}, "start must have shape"),
        ({"excitation": "wild"}, "Unknown excitation 'wild'"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        panda.demonstrate_sequence(TASK, KEY, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="A constraint must be a label"):
        panda.demonstrate_sequence([3], KEY)  # type: ignore[list-item]
