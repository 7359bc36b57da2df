"""The task frame: where it is, what is free in it, and how stiff a controller should be."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.constraints.frame import frame_arrays, locate, twist_map
from reframe_jax.geometry import transforms
from reframe_jax.simulation import synthetic

POSE = np.asarray(transforms.pose_exp(jnp.asarray([0.4, -0.9, 0.7, 1.0, -2.0, 3.0])))
ROTVEC, POSITION = (0.3, -0.5, 0.9), (0.1, 0.3, 0.1)

HOLDERS = {"G": "body", "H": "ground", "K": None, "L": None}  # None where that is not one body


def placed(label: str) -> rf.ConstraintFrame:
    """A constraint whose angular and linear axes agree at the pose."""
    return rf.ConstraintFrame.named(label, rotvec=ROTVEC, position=POSITION)


@pytest.mark.parametrize("label", rf.CONSTRAINTS)
def test_the_free_twists_are_those_of_the_constraint(label: str) -> None:
    """In the task frame, the twists that the constraint allows are those that the motion selection keeps."""
    frame = placed(label)
    task = rf.to_task_frame(frame, POSE)
    located = locate(frame_arrays(frame), jnp.asarray(POSE[:3, :3]), jnp.asarray(POSE[:3, 3]))
    free = np.array([*frame.angular_dof, *frame.linear_dof], bool)
    in_ground = task.transform if task.frame_id == "ground" else POSE @ task.transform
    np.testing.assert_allclose(in_ground[:3, 3], POSE[:3, 3] + located.lever, atol=1e-12)
    axes, lever = in_ground[:3, :3], in_ground[:3, 3] - POSE[:3, 3]
    allowed = np.linalg.inv(np.asarray(twist_map(located)))[:, free]  # columns (w, v) of {b} in {g}
    velocity = allowed[3:] + np.cross(allowed[:3], lever, axis=0)
    seen = np.concatenate([axes.T @ velocity, axes.T @ allowed[:3]])
    np.testing.assert_allclose(task.force_selection @ seen, 0, atol=1e-12)
    assert np.linalg.matrix_rank(seen) == task.free.sum() == free.sum()
    np.testing.assert_array_equal(task.motion_selection + task.force_selection, np.eye(6))
    assert task.turned == pytest.approx(0, abs=1e-5)
    assert task.constraint == rf.CONSTRAINTS[label].name


@pytest.mark.parametrize("label", HOLDERS)
def test_frames_fixed_in_one_body_hold_at_every_pose(label: str) -> None:
    here = rf.to_task_frame(placed(label), POSE, ground="map", body="tool")
    there = rf.to_task_frame(placed(label), POSE @ POSE, ground="map", body="tool")
    same = np.allclose(here.transform, there.transform, atol=1e-9)
    assert same == (HOLDERS[label] is not None)
    assert here.frame_id == {"body": "tool", "ground": "map", None: "map"}[HOLDERS[label]]
    expected = {
        "G": "Valid at every pose: the frame is fixed in tool.",
        "H": "Valid at every pose: the frame is fixed in map.",
        "K": "Valid at one pose of tool only. Fixed are: origin in tool, linear axes in map.",
        "L": "Valid at one pose of tool only. Fixed are: origin in map, linear axes in tool.",
    }
    assert here.validity == expected[label]


def test_stiffness_is_high_where_the_motion_is_free() -> None:
    task = rf.to_task_frame(placed("K"), POSE, stiff=(2000, 30), soft=(10, 0))
    assert task.free.tolist() == [True, True, False, True, True, True]
    assert task.stiffness.tolist() == [2000, 2000, 10, 30, 30, 30]
    matrix = task.in_frame_id(np.diag(task.stiffness))
    np.testing.assert_allclose(np.linalg.eigvalsh(matrix[:3, :3]), [10, 2000, 2000])
    normal = np.asarray(placed("K").linear_axes)[:, 2]  # of the plane, in the ground
    np.testing.assert_allclose(matrix[:3, :3] @ normal, 10 * normal)
    np.testing.assert_array_equal(matrix[:3, 3:], 0)


def turned_hinge(angle: float) -> rf.ConstraintFrame:
    """A cylinder joint whose hinge lies at an angle, in degrees, to its slide."""
    frame = placed("C")
    turn = Rotation.from_rotvec(ROTVEC) * Rotation.from_euler("z", angle, degrees=True)
    return replace(frame, angular_rotvec=jnp.asarray(turn.as_rotvec()))


def test_axes_that_nearly_agree_are_taken_to_agree() -> None:
    for angle, free in ((5, [1, 0, 0, 1, 0, 0]), (85, [1, 0, 0, 0, 1, 0])):
        task = rf.to_task_frame(turned_hinge(angle), POSE)
        assert task.turned == pytest.approx(5)
        assert task.free.astype(int).tolist() == free
        turn = task.transform[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
    with pytest.raises(ValueError, match="is 40 degrees, neither parallel nor perpendicular"):
        rf.to_task_frame(turned_hinge(40), POSE)


def test_yaml_and_json_say_the_same() -> None:
    frame = replace(placed("K"), position=jnp.asarray([1e-5, -2e-5, 0.0]))
    task = rf.to_task_frame(frame, np.eye(4), ground="base_link", task="contact", soft=(1e-5, 0))
    document = yaml.safe_load(task.to_yaml())
    assert document == json.loads(task.to_json())
    assert document["header"] == {"frame_id": "base_link"}
    assert document["child_frame_id"] == "contact"
    assert document["transform"]["translation"] == {"x": 1e-5, "y": -2e-5, "z": 0.0}
    turn = Rotation.from_quat([document["transform"]["rotation"][name] for name in "xyzw"])
    np.testing.assert_allclose(turn.as_matrix(), task.transform[:3, :3], atol=1e-8)
    control = document["control"]
    assert control["frame"] == "contact"
    assert control["order"] == ["x", "y", "z", "rx", "ry", "rz"]
    assert control["motion_selection"] == [1, 1, 0, 1, 1, 1]
    assert control["force_selection"] == [0, 0, 1, 0, 0, 0]
    assert control["stiffness"] == [1000, 1000, 1e-5, 50, 50, 50]
    assert control["stiffness_units"][2:4] == ["N/m", "N m/rad"]


def test_identifications_have_task_frames() -> None:
    poses = synthetic.simulate("K", jax.random.key(1), noise=1e-5).poses[:21]
    found = rf.identify(poses, dt=0.1)
    task = rf.to_task_frame(found, poses[-1])
    assert task.constraint == found.name == "Pin-plane contact"
    np.testing.assert_allclose(np.sort(task.free[:3]), [False, True, True])
    failed = replace(found, status_code=np.int32(rf.Status.NO_MOTION))
    with pytest.raises(ValueError, match="There is no task frame: "):
        rf.to_task_frame(failed, poses[-1])
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), found)
    with pytest.raises(ValueError, match="index one window first"):
        rf.to_task_frame(batch, poses[-1])


def test_what_is_no_task_frame_is_refused() -> None:
    frame = placed("K")
    with pytest.raises(ValueError, match=r"a finite pose of shape \(4, 4\), not one of shape \(2, 4, 4\)"):
        rf.to_task_frame(frame, np.stack([POSE, POSE]))
    with pytest.raises(ValueError, match="0 or more"):
        rf.to_task_frame(frame, POSE, soft=(-1, 0))
    with pytest.raises(ValueError, match=r"not a batch of shape \(2,\)"):
        rf.to_task_frame(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), frame), POSE)
