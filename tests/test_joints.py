"""Joints: of every class of constraint, with their zero, range and errors."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.constraints.catalogue import CONSTRAINTS
from reframe_jax.joints import fit_joint
from reframe_jax.simulation import synthetic

START = np.eye(4)
START[:3, :3] = Rotation.from_rotvec([0.4, -0.2, 1.9]).as_matrix()
START[:3, 3] = 0.3, -0.2, 0.5
ROTVEC = (0.3, -0.5, 0.9)

CHAINS = {
    "A": ("revolute", ["hinge"]),
    "B": ("prismatic", ["slide"]),
    "C": ("cylindrical", ["slide", "hinge"]),
    "D": ("planar", ["slide", "slide", "hinge"]),
    "E": ("general", ["slide", "slide", "hinge"]),
    "F": ("general", ["slide", "slide", "hinge"]),
    "I": ("general", ["slide", "hinge"]),
    "J": ("general", ["hinge", "slide"]),
    "K": ("general", ["slide", "slide", "ball"]),
    "L": ("general", ["ball", "slide", "slide"]),
    "spherical": ("spherical", ["ball"]),
    "fixed": ("fixed", []),
}


def frame_of(label: str) -> rf.ConstraintFrame:
    return rf.ConstraintFrame.named(label, rotvec=ROTVEC)


def recorded(frame: rf.ConstraintFrame, noise: float = 0.0) -> np.ndarray:
    simulation = synthetic.simulate(frame, jax.random.key(3), noise=noise, start=jnp.asarray(START))
    return np.asarray(simulation.poses)


def chain_of(*parts: tuple[str, Any, Any], coordinates: np.ndarray) -> np.ndarray:
    """Poses of a chain, by SciPy: each part moves everything after it."""
    poses = np.tile(START, (len(coordinates), 1, 1))
    for column, (kind, axis, point) in reversed(list(enumerate(parts))):
        moved = np.tile(np.eye(4), (len(coordinates), 1, 1))
        if kind == "slide":
            moved[:, :3, 3] = coordinates[:, column, None] * np.asarray(axis)
        else:
            vectors = coordinates[:, column, None] * np.asarray(axis)
            moved[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
            moved[:, :3, 3] = point - moved[:, :3, :3] @ point
        poses = moved @ poses
    return poses


@pytest.mark.parametrize("turns", [0.1, 5.0])
def test_a_screw_is_one_part_with_a_pitch(turns: float) -> None:
    frame = frame_of("screw")
    turned = 2 * np.pi * turns * np.sin(np.linspace(0, 1.5, 201))
    axis = np.asarray(Rotation.from_rotvec(ROTVEC).apply([1.0, 0.0, 0.0]))
    axis, point = START[:3, :3] @ axis, START[:3, 3] + START[:3, :3] @ np.asarray(frame.position)
    parts = ("slide", 0.03 * axis, None), ("hinge", axis, point)
    poses = chain_of(*parts, coordinates=np.stack([turned, turned], axis=1))
    joint = fit_joint(frame, poses, pitch=0.03)
    (part,) = joint.parts
    assert (joint.type, joint.name, part.kind, part.pitch) == ("screw", "Screw joint", "hinge", 0.03)
    assert joint.position_error < 1e-6
    assert joint.range is not None
    np.testing.assert_allclose(np.ptp(joint.range), np.ptp(turned), rtol=1e-6)
    np.testing.assert_allclose(joint.poses(joint.coordinates(poses[100:])), poses[100:], atol=1e-6)
    assert "188.5 mm per turn" in str(joint)
    assert "The body slides 188.5 mm along the axis per turn; the thread is right-handed." in joint.gauge


@pytest.mark.parametrize(("label", "pitch"), [("A", 0.1), ("K", 0.1), ("I", 0.1), ("C", 0.0), ("C", np.nan)])
def test_what_has_no_pitch_is_refused(label: str, pitch: float) -> None:
    frame = frame_of(label)
    with pytest.raises(ValueError, match="pitch"):
        fit_joint(frame, recorded(frame), pitch=pitch)


@pytest.mark.parametrize("label", CHAINS)
def test_a_chain_follows_the_recording(label: str) -> None:
    frame = frame_of(label)
    poses = recorded(frame)
    joint = fit_joint(frame, poses, parent="table", child="lid")
    kind, parts = CHAINS[label]
    assert (joint.type, [part.kind for part in joint.parts]) == (kind, parts)
    assert (joint.name, joint.parent, joint.child) == (rf.constraint(label).name, "table", "lid")
    assert joint.is_envelope == (label in "EF")
    assert joint.position_error < 1e-7
    assert joint.rotation_error < 1e-6
    coordinates = joint.coordinates(poses)
    np.testing.assert_allclose(joint.poses(coordinates), poses, atol=1e-6)
    np.testing.assert_allclose(coordinates[0], 0, atol=1e-7)
    first = 0
    for part in joint.parts:
        values = coordinates[:, first : first + part.width]
        seen = np.linalg.norm(values, axis=1) if part.kind == "ball" else values
        assert part.high == pytest.approx(seen.max())
        assert part.low == pytest.approx(0 if part.kind == "ball" else seen.min())
        first += part.width


@pytest.mark.parametrize("kind", rf.LinearType)
@pytest.mark.parametrize("label", "ABCD")
def test_types_that_tie_give_the_same_joint(label: str, kind: rf.LinearType) -> None:
    """A hinge is one in every frame type: here the geometry of the frame at rest, told in each of them."""
    frame = frame_of(label)
    poses = recorded(frame)
    turn, origin = START[:3, :3], START[:3, :3] @ np.asarray(frame.position) + START[:3, 3]
    axes = turn @ np.asarray(frame.linear_axes)

    def rotvec(on_body: bool) -> np.ndarray:
        return Rotation.from_matrix(turn.T @ axes if on_body else axes).as_rotvec()

    other = rf.ConstraintFrame(
        angular_type=kind.orientation_body,
        angular_dof=frame.angular_dof,
        linear_type=kind,
        linear_dof=frame.linear_dof,
        angular_rotvec=jnp.asarray(rotvec(kind.name[0] == "B")),
        linear_rotvec=jnp.asarray(rotvec(kind.name[0] == "B")),
        position=jnp.asarray(frame.position if kind.name[1] == "B" else origin),
    )
    expected, joint = fit_joint(frame, poses), fit_joint(other, poses)
    assert joint.type == expected.type
    assert joint.axis is not None
    np.testing.assert_allclose(joint.axis, expected.axis, atol=1e-7)
    np.testing.assert_allclose(joint.point, expected.point, atol=1e-7)
    np.testing.assert_allclose(joint.home, expected.home, atol=1e-7)
    assert joint.position_error < 1e-7


@pytest.mark.parametrize("label", "EF")
def test_what_the_chain_does_not_hold_is_said(label: str) -> None:
    """A wheel on its plane: the chain holds the plane, and lets the wheel move sideways."""
    frame = frame_of(label)
    joint = fit_joint(frame, recorded(frame), child="wheel")
    assert joint.gauge[0].startswith(
        "The chain constrains the plane of the motion only. Like a wheel, the constraint also blocks one more"
    )
    slides = [part.axis for part in joint.parts[:2]]
    np.testing.assert_allclose(np.abs(np.cross(*slides) @ joint.parts[2].axis), 1, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("kind", [rf.LinearType.BB, rf.LinearType.GG])
def test_a_wheel_that_leans_reaches_all_positions(kind: rf.LinearType, count: int) -> None:
    """A slide that turns with a hinge it is not perpendicular to reaches a plane and its normal."""
    frame = rf.ConstraintFrame(
        angular_type=kind.orientation_body,
        angular_dof=(0, 0, 1),
        linear_type=kind,
        linear_dof=(int(count == 2), 0, 1),
        angular_rotvec=jnp.zeros(3),
        linear_rotvec=jnp.asarray([0.7, 0.1, 0.0]),
        position=jnp.asarray([0.1, 0.2, 0.0]),
    )
    poses = np.asarray(synthetic.simulate(frame, jax.random.key(4), noise=0.0).poses)
    joint = fit_joint(frame, poses)
    assert [part.kind for part in joint.parts] == ["slide"] * 3 + ["hinge"]
    lost = "one more velocity" if count == 2 else "two more velocities"
    assert joint.gauge[0].startswith(
        f"The chain constrains the axis of rotation only. Like a wheel, the constraint also blocks {lost}"
    )
    assert joint.position_error < 1e-7


@pytest.mark.parametrize("label", "GH")
def test_contacts_are_no_joints(label: str) -> None:
    frame = frame_of(label)
    joint = fit_joint(frame, recorded(frame))
    assert (joint.type, joint.parts, joint.is_chain, joint.axis) == ("general", (), False, None)
    assert joint.name == CONSTRAINTS[label].name
    assert "restricts velocities" in joint.gauge[0]
    assert "error" not in str(joint)
    assert np.isnan(joint.position_error)
    with pytest.raises(ValueError, match="no coordinates determine the pose"):
        joint.poses([])
    with pytest.raises(ValueError, match="no coordinates determine the pose"):
        joint.coordinates(np.eye(4)[None])


def test_a_free_body_floats() -> None:
    frame = frame_of("unconstrained")
    joint = fit_joint(frame, recorded(frame))
    assert (joint.type, joint.is_chain) == ("floating", False)
    assert "free" in joint.gauge[0]


def test_a_universal_joint_has_an_axis_in_each_body(rng: np.random.Generator) -> None:
    """No frame fixed in one body holds its still direction: the axes are given."""
    first, second, point = np.array([0.0, 0.6, 0.8]), np.array([1.0, 0, 0]), np.array([0.2, 0.1, 0.3])
    coordinates = rng.uniform(-0.5, 0.5, (60, 2))
    coordinates[0] = 0
    poses = chain_of(("hinge", first, point), ("hinge", second, point), coordinates=coordinates)
    still = Rotation.align_vectors([np.cross(first, second)], [[0, 0, 1.0]])[0].as_rotvec()
    frame = rf.ConstraintFrame(
        angular_type=rf.AngularType.G,
        angular_dof=(1, 1, 0),
        linear_type=rf.LinearType.GG,
        linear_dof=(0, 0, 0),
        angular_rotvec=jnp.asarray(still),
        linear_rotvec=jnp.zeros(3),
        position=jnp.asarray(point),
    )
    joint = fit_joint(frame, poses, universal=[first, START[:3, :3].T @ second])
    assert (joint.type, joint.name) == ("universal", "Universal joint")
    np.testing.assert_allclose([part.axis for part in joint.parts], [first, second], atol=1e-6)
    np.testing.assert_allclose(joint.coordinates(poses), coordinates, atol=1e-5)
    assert joint.rotation_error < 1e-5
    # three rotations, and axes that nobody knows, are no chain
    free = np.array(poses)
    free[:, :3, :3] = Rotation.random(60, rng).as_matrix()
    for other in fit_joint(frame, free, universal=[first, START[:3, :3].T @ second]), fit_joint(frame, poses):
        assert (other.type, other.is_chain) == ("general", False)
        assert "two hinges do not fit its rotations, or their axes are not known" in other.gauge[0]
    with pytest.raises(ValueError, match="at least two free rotations"):
        fit_joint(frame_of("A"), poses, universal=[first, second])
    # on a slide, the two hinges come along
    along = np.array([0.6, 0.0, 0.8])
    on_slide = np.column_stack([rng.uniform(0, 0.3, 60), coordinates])
    slid = chain_of(
        ("slide", along, None), ("hinge", first, point), ("hinge", second, point), coordinates=on_slide
    )
    rail = replace(
        frame,
        linear_type=rf.LinearType.GB,
        linear_dof=(0, 0, 1),
        linear_rotvec=jnp.asarray(Rotation.align_vectors([along], [[0, 0, 1.0]])[0].as_rotvec()),
        position=jnp.asarray(START[:3, :3].T @ (point - START[:3, 3])),
    )
    joint = fit_joint(rail, slid, universal=[first, START[:3, :3].T @ second])
    assert [part.kind for part in joint.parts] == ["slide", "hinge", "hinge"]
    assert joint.position_error < 1e-5
    assert joint.rotation_error < 1e-5


@pytest.mark.parametrize("label", ["K", "L", "spherical"])
def test_three_hinges_stand_for_a_ball(label: str) -> None:
    frame = frame_of(label)
    poses = recorded(frame)
    joint = fit_joint(frame, poses)
    hinged = joint.without_balls()
    kinds = [part.kind for part in joint.parts]
    place = kinds.index("ball")
    assert [part.kind for part in hinged.parts] == [*kinds[:place], *["hinge"] * 3, *kinds[place + 1 :]]
    coordinates = hinged.coordinates(poses)
    np.testing.assert_allclose(hinged.poses(coordinates), poses, atol=1e-6)
    ranges = [(part.low, part.high) for part in hinged.parts]
    np.testing.assert_allclose(ranges, np.stack([coordinates.min(0), coordinates.max(0)], axis=1), atol=1e-6)
    assert "Three hinges" in hinged.gauge[-1]
    assert fit_joint(frame_of("A"), recorded(frame_of("A"))).without_balls().parts[0].kind == "hinge"


def test_hinges_that_would_lock_do_not_stand_for_a_ball(rng: np.random.Generator) -> None:
    frame = frame_of("spherical")
    poses = recorded(frame)
    centre = fit_joint(frame, poses).point
    turns = Rotation.random(400, rng).as_matrix()
    free = np.tile(np.eye(4), (400, 1, 1))
    free[:, :3, :3] = turns
    free[:, :3, 3] = centre - turns @ np.asarray(frame.position)
    ball = rf.ConstraintFrame(
        rf.AngularType.G, (1, 1, 1), rf.LinearType.GB, (0, 0, 0), jnp.zeros(3), jnp.zeros(3), frame.position
    )
    joint = fit_joint(ball, free)
    assert joint.position_error < 1e-7
    with pytest.raises(ValueError, match="reach their gimbal lock"):
        joint.without_balls()


def test_what_rotates_and_slides_otherwise_is_a_chain(rng: np.random.Generator) -> None:
    """Classes without a name: a table that slides both ways, a ball on a rail, a hinge that slides askew."""
    axes = Rotation.from_rotvec(ROTVEC).as_matrix()
    along = jnp.asarray(ROTVEC)
    time = np.linspace(0, 3, 40)
    steps = np.stack([0.2 * np.sin(time), 0.1 * np.sin(2.2 * time)], axis=1)
    zero, point = jnp.zeros(3), jnp.asarray([0.1, 0.2, 0.3])

    table = rf.ConstraintFrame(rf.AngularType.G, (0, 0, 0), rf.LinearType.BB, (0, 1, 1), zero, along, point)
    slides = [("slide", axis, None) for axis in (START[:3, :3] @ axes).T[1:]]
    joint = fit_joint(table, chain_of(*slides, coordinates=steps))
    assert [part.kind for part in joint.parts] == ["slide", "slide"]
    assert joint.position_error < 1e-7
    assert joint.name == "Unnamed: 0 rotations, 2 translations"

    askew = np.array([0.0, 0.6, 0.8])
    hinge = rf.ConstraintFrame(
        rf.AngularType.G,
        (0, 0, 1),
        rf.LinearType.GB,
        (0, 0, 1),
        zero,
        jnp.asarray(Rotation.align_vectors([askew], [[0, 0, 1.0]])[0].as_rotvec()),
        jnp.asarray(START[:3, :3].T @ (np.array([0.5, 0.5, 0.5]) - START[:3, 3])),
    )
    parts = ("slide", askew, None), ("hinge", [0, 0, 1.0], np.full(3, 0.5))
    joint = fit_joint(hinge, chain_of(*parts, coordinates=steps[:, ::-1] * [1, 5]))
    assert joint.name == "Unnamed: 1 rotation, 1 translation in GB, axes oblique"
    assert joint.position_error < 1e-7

    free = rf.ConstraintFrame(rf.AngularType.G, (0, 0, 1), rf.LinearType.BG, (1, 1, 1), zero, zero, point)
    poses = chain_of(("hinge", [0, 0, 1.0], np.zeros(3)), coordinates=steps)
    poses[:, :3, 3] += rng.normal(size=(40, 3))
    joint = fit_joint(free, poses)
    assert [part.kind for part in joint.parts] == ["slide"] * 3 + ["hinge"]
    assert joint.position_error < 1e-7


def test_full_turns_are_continuous() -> None:
    frame = frame_of("A")
    axis, point = np.array([0.0, 0.6, -0.8]), np.array([0.1, 0.2, 0.3])
    angles = np.linspace(0, 3 * np.pi, 80)[:, None]
    poses = chain_of(("hinge", axis, point), coordinates=angles)
    frame = rf.ConstraintFrame(
        rf.AngularType.G,
        (0, 0, 1),
        rf.LinearType.GG,
        (0, 0, 0),
        jnp.asarray(Rotation.align_vectors([axis], [[0, 0, 1.0]])[0].as_rotvec()),
        jnp.zeros(3),
        jnp.asarray(point),
    )
    joint = fit_joint(frame, poses)
    assert joint.type == "continuous"
    assert joint.axis is not None
    np.testing.assert_allclose(joint.axis, -axis, atol=1e-9)  # the largest component is positive
    assert joint.range == pytest.approx((-3 * np.pi, 0))
    assert joint.range is not None
    short = fit_joint(frame, poses[:50])
    assert short.type == "revolute"


def test_zero_and_range_are_averages_over_noise() -> None:
    """The home pose has the noise of all poses together, not that of the first one."""
    frame = frame_of("A")
    exact, noisy = fit_joint(frame, recorded(frame)), fit_joint(frame, recorded(frame, noise=2e-3))
    assert 1e-3 < noisy.position_error < 5e-3
    assert 3e-3 < noisy.rotation_error < 2e-2
    # along the joint the zero follows the first pose, across it it does not
    nearest = exact.coordinates(noisy.home[None])
    off = np.linalg.norm(exact.poses(nearest)[0, :3, 3] - noisy.home[:3, 3])
    assert off < 1e-3
    assert noisy.range == pytest.approx(exact.range, abs=0.05)


def test_joints_say_what_was_chosen() -> None:
    frame = frame_of("A")
    text = str(fit_joint(frame, recorded(frame), child="door"))
    assert text.startswith("Revolute joint: revolute joint from ground to door\n  axis   (")
    for words in (
        " m\n  hinge  ",
        " deg\n  error  ",
        "nearest to the origin of the door",
        "sign of an axis is arbitrary",
    ):
        assert words in text
    frame = frame_of("D")
    assert "slides within the plane" in str(fit_joint(frame, recorded(frame)))


def test_what_cannot_be_a_joint_is_refused() -> None:
    frame = frame_of("A")
    poses = recorded(frame)
    with pytest.raises(ValueError, match=r"Expected poses of shape \(K\+1, 4, 4\), not \(4, 4\)"):
        fit_joint(frame, poses[0])
    with pytest.raises(ValueError, match="Expected finite poses"):
        fit_joint(frame, np.full_like(poses, np.nan))
    with pytest.raises(ValueError, match=r"not a batch of shape \(2,\)"):
        fit_joint(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), frame), poses)
    with pytest.raises(ValueError, match="two different names, not 'door' and 'door'"):
        fit_joint(frame, poses, parent="door", child="door")
    with pytest.raises(ValueError, match="a positive length in m, not 0"):
        fit_joint(frame, poses, length=0)
    joint = fit_joint(frame, poses)
    with pytest.raises(ValueError, match=r"coordinates of shape \(..., 1\), not \(2,\)"):
        joint.poses([0.0, 1.0])
    with pytest.raises(ValueError, match=r"poses of shape \(K, 4, 4\), not \(4, 4\)"):
        joint.coordinates(poses[0])


def test_identifications_become_joints() -> None:
    """Outliers take no part, and windows without a result have no joint."""
    poses = recorded(frame_of("A"), noise=1e-4)[:21].copy()
    poses[10, :3, 3] += 1.0
    found = rf.identify(poses, dt=0.1)
    assert found.name == "Revolute joint"
    joint = found.to_joint(poses, parent="wall", child="door")
    assert (joint.type, joint.parent, joint.child) == ("revolute", "wall", "door")
    assert joint.position_error < 5e-4
    assert 0.03 <= joint.length <= 3
    with pytest.raises(ValueError, match=r"the poses that were identified, \(21, 4, 4\), not \(20, 4, 4\)"):
        found.to_joint(poses[1:])
    still = replace(found, status_code=np.int32(rf.Status.NO_MOTION))
    with pytest.raises(ValueError, match="There is no joint: "):
        still.to_joint(poses)
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), found)
    with pytest.raises(ValueError, match="index one window first"):
        batch.to_joint(poses)
