"""Robot descriptions: written, read by programs that are not ours, and moved along the recording."""

import io
import re
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax.joints import fit_joint
from reframe_jax.simulation import synthetic

START = np.eye(4)
START[:3, :3] = Rotation.from_rotvec([0.4, -0.2, 1.9]).as_matrix()
START[:3, 3] = 0.3, -0.2, 0.5
NOISE = 1e-4  # m; the recorded poses are this far from any joint
LABELS = ("A", "B", "C", "D", "E", "F", "I", "J", "K", "L", "screw", "spherical", "fixed")
PITCH = -0.04  # m/rad, of the screw


def recorded_joint(label: str) -> tuple[rf.Joint, np.ndarray]:
    """A joint, and the noisy poses that it was fitted to."""
    frame = rf.ConstraintFrame.named(label, rotvec=(0.3, -0.5, 0.9))
    key = jax.random.key(5)
    pitch = PITCH if label == "screw" else None
    start = jnp.asarray(START)
    simulation = synthetic.simulate(frame, key, noise=NOISE, start=start, duration=3.0, pitch=pitch)
    poses = np.asarray(simulation.poses)
    return fit_joint(frame, poses, parent="wall", child="door", pitch=pitch), poses


def negative(joint: rf.Joint) -> rf.Joint:
    """The same joint with all axes turned over, so that their largest components are negative."""
    turned = tuple(
        part if part.kind == "ball" else replace(part, axis=-part.axis, low=-part.high, high=-part.low)
        for part in joint.parts
    )
    return replace(joint, parts=turned)


def thread_of(text: str, model: mujoco.MjModel) -> tuple[int, int, float]:
    """Numbers of the slide and of the hinge of a screw in MuJoCo's model, and what couples them, m/rad."""
    mimic = ElementTree.fromstring(text).find("joint/mimic")
    if mimic is not None:
        return (
            model.joint("door_slide").id,
            model.joint(mimic.get("joint")).id,
            float(mimic.get("multiplier", "")),
        )
    assert (model.neq, model.eq_type[0]) == (1, mujoco.mjtEq.mjEQ_JOINT)
    offset, factor, *others = model.eq_data[0, :5]
    assert not any((offset, *others))
    return model.eq_obj1id[0], model.eq_obj2id[0], factor


def by_mujoco(text: str, joint: rf.Joint, coordinates: np.ndarray) -> np.ndarray:
    """Poses of the child as MuJoCo sees them, within the limits of the file."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    assert model.body("wall").id != 0
    assert model.body("door").mass[0] > 0
    threads = [part for part in joint.parts if part.pitch]
    assert model.njnt == len(joint.parts) + len(threads)
    poses = np.tile(np.eye(4), (len(coordinates), 1, 1))
    for pose, values in zip(poses, coordinates, strict=True):
        first = 0
        for index, part in enumerate(joint.parts):
            own = values[first : first + part.width]
            first += part.width
            low, high = model.jnt_range[index]
            assert low - 1e-5 <= (np.linalg.norm(own) if part.kind == "ball" else own[0]) <= high + 1e-5
            if part.kind == "ball":
                own = np.roll(Rotation.from_rotvec(own @ joint.home[:3, :3]).as_quat(), 1)
            start = model.jnt_qposadr[index]
            data.qpos[start : start + len(own)] = own
            if part.pitch:
                slide, turn, factor = thread_of(text, model)
                data.qpos[slide] = factor * data.qpos[turn]
        mujoco.mj_kinematics(model, data)
        pose[:3, :3] = data.body("door").xmat.reshape(3, 3)
        pose[:3, 3] = data.body("door").xpos
    mujoco.mj_step(model, data)  # masses and limits are such that it moves
    assert np.isfinite(data.qpos).all()
    return poses


def by_yourdfpy(text: str, joint: rf.Joint, coordinates: np.ndarray) -> np.ndarray:
    yourdfpy = pytest.importorskip("yourdfpy", reason="needs yourdfpy")
    robot = yourdfpy.URDF.load(io.BytesIO(text.encode()), load_meshes=False, build_scene_graph=True)
    assert robot.validate()
    assert len(robot.actuated_joint_names) == len(joint.parts)
    poses = []
    for values in coordinates:
        robot.update_cfg(dict(zip(robot.actuated_joint_names, values, strict=True)))
        poses.append(robot.get_transform("door", "wall"))
    return np.asarray(poses)


def pose_of(text: str | None) -> np.ndarray:
    """A pose of SDF: x, y, z, roll, pitch, yaw."""
    numbers = [float(word) for word in (text or "").split()]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
    pose[:3, 3] = numbers[:3]
    return pose


def by_the_sdf_specification(text: str, joint: rf.Joint, coordinates: np.ndarray) -> np.ndarray:
    """Each joint moves its child, and all that hangs on it, about its own place in the model."""
    root = ElementTree.fromstring(text)
    assert root.get("version") == ("1.10" if joint.type == "screw" else "1.9")
    (model,) = root.iter("model")
    links = {link.get("name"): pose_of(link.findtext("pose")) for link in model.iter("link")}
    joints = {made.findtext("child"): made for made in model.iter("joint")}
    assert (joints["wall"].findtext("parent"), joints["wall"].get("type")) == ("world", "fixed")
    chain, link = [], "door"
    while link != "wall":
        chain.insert(0, joints[link])
        link = joints[link].findtext("parent") or ""
    assert len(links) == max(len(joint.parts), 1) + 1
    moved = np.tile(np.eye(4), (len(coordinates), 1, 1))
    first = 0
    for made in chain:
        kind, motion = made.get("type"), np.tile(np.eye(4), (len(coordinates), 1, 1))
        if kind == "fixed":
            continue
        place = made.find("pose")
        assert place is not None
        assert place.get("relative_to") == "__model__"
        point = pose_of(place.text)[:3, 3]
        if kind == "ball":
            vectors = coordinates[:, first : first + 3]
        else:
            xyz = made.find("axis/xyz")
            assert xyz is not None
            assert xyz.get("expressed_in") == "__model__"
            axis = np.array([float(word) for word in (xyz.text or "").split()])
            assert np.linalg.norm(axis) == pytest.approx(1)
            vectors = coordinates[:, first, None] * axis
            low, high = (float(made.findtext(f"axis/limit/{name}") or "nan") for name in ("lower", "upper"))
            assert low - 1e-9 <= coordinates[:, first].min()
            assert coordinates[:, first].max() <= high + 1e-9
        first += vectors.shape[1] if kind == "ball" else 1
        if kind == "prismatic":
            motion[:, :3, 3] = vectors
        else:
            assert kind in ("revolute", "screw", "ball")
            motion[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
            motion[:, :3, 3] = point - motion[:, :3, :3] @ point
            lead = float(made.findtext("screw_thread_pitch") or 0)
            assert (lead != 0) == (kind == "screw")
            motion[:, :3, 3] += lead * vectors / (2 * np.pi)
        moved = moved @ motion
    return moved @ links["door"]


READERS: dict[str, tuple[Callable[..., str], Callable[..., np.ndarray]]] = {
    "urdf, mujoco": (rf.to_urdf, by_mujoco),
    "urdf, yourdfpy": (rf.to_urdf, by_yourdfpy),
    "mjcf": (rf.to_mjcf, by_mujoco),
    "sdf": (rf.to_sdf, by_the_sdf_specification),
}


@pytest.mark.parametrize(
    ("label", "reader"),
    [(label, name) for label in LABELS for name in READERS],
)
def test_round_trips_follow_the_recording(label: str, reader: str) -> None:
    """In mm, along the whole recorded range, and with negative axes too."""
    write, read = READERS[reader]
    positive, poses = recorded_joint(label)
    if "urdf" in reader:  # which has no balls
        positive = positive.without_balls()
    for joint in (positive, negative(positive)):
        moved = read(write(joint), joint, joint.coordinates(poses))
        away = 1e3 * np.linalg.norm(moved[:, :3, 3] - poses[:, :3, 3], axis=1)  # mm
        assert away.max() < 8e3 * NOISE
        turned = np.linalg.norm(moved[:, :3, :3] - poses[:, :3, :3], axis=(1, 2))
        assert turned.max() < 30 * NOISE
        # of the joint itself, nothing but the digits of the file is lost
        np.testing.assert_allclose(moved, joint.poses(joint.coordinates(poses)), atol=5e-6)


@pytest.mark.parametrize("write", [rf.to_urdf, rf.to_mjcf, rf.to_sdf])
def test_files_say_what_they_hold(write: Callable[..., str]) -> None:
    joint, _ = recorded_joint("A")
    text = write(replace(joint, name="A -- B"), mass=2.5)
    assert "A - - B, identified by reframe_jax from recorded poses of door in wall." in text
    assert re.search(r"RMS distance from the recording: 0\.\d+ mm, 0\.\d+ deg\.", text)
    for sentence in joint.gauge:
        assert sentence in text
    if write is not rf.to_sdf:
        model = mujoco.MjModel.from_xml_string(text)
        assert model.body("door").mass[0] == pytest.approx(2.5)
        assert model.body("door").inertia[0] == pytest.approx(0.4 * 2.5 * 0.1**2)


def test_full_turns_have_no_limits() -> None:
    joint, _ = recorded_joint("A")
    (part,) = joint.parts
    endless = replace(joint, type="continuous", parts=(replace(part, low=-1.0, high=6.0),))
    robot = ElementTree.fromstring(rf.to_urdf(endless))
    (hinge,) = (made for made in robot.iter("joint") if made.get("name") == "door_hinge")
    limit = hinge.find("limit")
    assert limit is not None
    assert (hinge.get("type"), limit.get("lower")) == ("continuous", None)
    assert not mujoco.MjModel.from_xml_string(rf.to_mjcf(endless)).jnt_limited.any()
    model = ElementTree.fromstring(rf.to_sdf(endless))
    types = {made.get("name"): made.get("type") for made in model.iter("joint")}
    assert types == {"wall_fixed": "fixed", "door_hinge": "continuous"}
    assert model.find("model/joint/axis/limit") is None


def test_a_screw_that_made_full_turns_keeps_its_limits() -> None:
    joint, _ = recorded_joint("screw")
    (part,) = joint.parts
    turned = replace(joint, parts=(replace(part, low=-1.0, high=20.0),))
    robot = ElementTree.fromstring(rf.to_urdf(turned))
    limits = {made.get("name"): made.find("limit") for made in robot.iter("joint")}
    limit = limits["door_slide"]
    assert limit is not None
    np.testing.assert_allclose(
        [float(limit.get(end, "nan")) for end in ("lower", "upper")], [20 * PITCH, -PITCH], rtol=1e-6
    )
    model = mujoco.MjModel.from_xml_string(rf.to_mjcf(turned))
    np.testing.assert_allclose(model.jnt_range[model.joint("door_hinge").id], [-1, 20], rtol=1e-6)
    assert ElementTree.fromstring(rf.to_sdf(turned)).find("model/joint[@type='screw']/axis/limit") is not None


def test_half_turned_bodies_keep_their_orientation() -> None:
    """Angles of roll, pitch and yaw at a pitch of 90 degrees, where they are not unique."""
    joint, _ = recorded_joint("A")
    for pitch in (np.pi / 2, -np.pi / 2):
        home = np.eye(4)
        home[:3, :3] = Rotation.from_euler("xyz", [0.3, pitch, 0.8]).as_matrix()
        placed = replace(joint, home=home)
        for write, read in READERS.values():
            moved = read(write(placed), placed, np.zeros((1, 1)))
            np.testing.assert_allclose(moved[0], home, atol=5e-6)


@pytest.mark.parametrize("write", [rf.to_urdf, rf.to_mjcf, rf.to_sdf])
def test_what_a_format_cannot_say_is_refused_in_words(write: Callable[..., str]) -> None:
    for label in "GH":
        frame = rf.ConstraintFrame.named(label)
        contact = fit_joint(frame, np.asarray(synthetic.simulate(frame, jax.random.key(0)).poses))
        with pytest.raises(ValueError, match=rf"cannot express '{contact.name}'. No chain .* every pose can"):
            write(contact)
    frame = rf.ConstraintFrame.named("unconstrained")
    free = fit_joint(frame, np.asarray(synthetic.simulate(frame, jax.random.key(0)).poses))
    with pytest.raises(ValueError, match="There is no joint to write as"):
        write(free)
    joint, _ = recorded_joint("A")
    for mass in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="Expected a positive mass in kg"):
            write(joint, mass=mass)


def test_urdf_has_no_balls() -> None:
    """Three hinges stand for them where they do not lock."""
    joint, _ = recorded_joint("spherical")
    text = rf.to_urdf(joint)
    assert "Three hinges through the centre replace the ball." in text
    (ball,) = joint.parts
    with pytest.raises(ValueError, match=r"URDF has no ball joint\. Spherical joint: three hinges cannot"):
        rf.to_urdf(replace(joint, parts=(replace(ball, hinges=()),)))


def test_files_say_which_velocities_they_do_not_hold() -> None:
    joint, _ = recorded_joint("E")
    for write in (rf.to_urdf, rf.to_mjcf, rf.to_sdf):
        assert "the constraint also blocks one more velocity of the door at zero" in write(joint)


def test_models_can_be_edited() -> None:
    joint, _ = recorded_joint("A")
    spec = rf.to_mjspec(joint)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 0.1))
    spec.body("door").add_site(name="handle", pos=(0.1, 0, 0))
    model = spec.compile()
    assert (model.nq, model.nsite, model.ngeom) == (1, 1, 2)
    assert not spec.compiler.degree
