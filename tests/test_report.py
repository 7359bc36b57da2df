"""What people and programs read, against results made by hand."""

import json
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.export.common import Window
from reframe_jax.export.json import to_document, to_json, to_record
from reframe_jax.export.table import to_table
from reframe_jax.identification.cautions import caution_codes
from reframe_jax.identification.entry import identify
from reframe_jax.identification.results import (
    AllCandidates,
    AngularFrame,
    Candidates,
    Identification,
    LinearFrame,
    PoseNoise,
)
from reframe_jax.identification.velocities import frame_velocities
from reframe_jax.motion.checks import Status
from reframe_jax.simulation import synthetic

QUARTER = (0.0, 0.0, np.pi / 2)  # axes y, -x, z


def candidates(types: int, dof: tuple[int, int, int], position: bool) -> Candidates:
    def each(value: Any) -> Any:
        return np.repeat(np.asarray(value)[None], types, axis=0)

    return Candidates(
        rotvec=each(QUARTER),
        dof=each(dof),
        rms=each([0.01, 0.02, 0.3]),
        norm=np.arange(1.0, types + 1),
        free_rotation=each([False, False, True]),
        position=each([1.0, 2.0, 3.0]) if position else None,
        free_position=each(np.zeros((3, 3))) if position else None,
        on_bounds=each(False) if position else None,
        agreement=each(0.5) if position else None,
    )


def identification(
    linear_type: LinearType = LinearType.GB,
    angular_dof: tuple[int, int, int] = (0, 0, 1),
    linear_dof: tuple[int, int, int] = (0, 0, 0),
    status: Status = Status.OK,
    free_position: Any = None,
    tied: tuple[LinearType, ...] = (),
    twin: Any = None,
    free: Any = ((0.0, 0.1, 1.0), (0.0, 0.0, 0.03)),
    poses: int = 21,
    lag: int = 1,
    outliers: tuple[int, ...] = (),
    classes: dict[tuple[LinearType, int, int], float] | None = None,
    pitch: float | None = None,
) -> Identification:
    """A revolute joint about z, unless told otherwise."""
    probability = np.zeros((4, 4, 4))
    classes = {(linear_type, sum(angular_dof), sum(linear_dof)): 0.75} if classes is None else classes
    for index, value in classes.items():
        probability[index] = value
    one, three = np.diag([0.0, 0.0, 1.0]), np.array
    ties = np.isin(np.arange(4), [linear_type, *tied])
    codes = caution_codes(
        np.array([poses - len(outliers)]), np.array([lag]), (np.ones((1, 3)),) * 2, None, {}
    )
    return Identification(
        angular=AngularFrame(
            type_code=np.int32(AngularType.B),
            rotvec=three(QUARTER),
            dof=three(angular_dof),
            free_probability=three(free[0]),
            rms=three([0.01, 0.02, 0.3]),
            norm=np.float64(0.0391),
            norms=three([0.04, 0.0391]),
            tied=three([True, True]),
            free_rotation=three([False, False, True]),
        ),
        linear=LinearFrame(
            type_code=np.int32(linear_type),
            rotvec=three(QUARTER),
            position=three([0.1, -0.25, 0.0]),
            twin=three([0.1, -0.25, 0.0] if twin is None else twin),
            has_twin=np.bool_(twin is not None),
            dof=three(linear_dof),
            free_probability=three(free[1]),
            rms=three([0.001, 0.002, 0.25]),
            norm=np.float64(0.00794),
            norms=three([0.5, 0.25, 0.125, 0.0625]),
            tied=ties,
            free_rotation=three([True, True, True]),
            free_position=one if free_position is None else free_position,
            coupled_position=np.zeros((3, 3)),
        ),
        candidates=AllCandidates(candidates(2, angular_dof, False), candidates(4, linear_dof, True)),
        class_probability=probability,
        screw_probability=np.float64(0.0 if pitch is None else 0.9),
        pitch=np.float64(np.nan if pitch is None else pitch),
        universal_probability=np.float64(0),
        universal_axes=np.full((2, 3), np.nan),
        noise=PoseNoise(position=np.float64(1.2e-4), rotation=np.radians(0.081)),
        lag=np.int32(lag),
        refined=np.bool_(lag > 1),
        counted=~np.isin(np.arange(poses), outliers),
        status_code=np.int32(status),
        warning_codes=np.asarray(codes)[0],
    )


def batch(*windows: Identification) -> Identification:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *windows)


def blank(found: Identification, status: Status) -> Identification:
    """What ``identify`` returns for a window it could not use."""

    def empty(leaf: Any) -> Any:
        return np.full_like(leaf, np.nan) if np.issubdtype(leaf.dtype, np.floating) else np.zeros_like(leaf)

    return Identification(**{**vars(jax.tree.map(empty, found)), "status_code": np.int32(status)})


# Tables


@pytest.mark.parametrize(
    ("pitch", "line"), [(0.02, "125.7 mm a turn, right"), (-0.001, "6.283 mm a turn, left")]
)
def test_a_screw_has_a_pitch(pitch: float, line: str) -> None:
    found = identification(
        angular_dof=(0, 0, 1),
        linear_dof=(0, 0, 1),
        classes={(LinearType.GB, 1, 1): 0.5, (LinearType.BG, 1, 1): 0.3},
        pitch=pitch,
    )
    assert found.name == "Screw joint"
    assert found.probability == pytest.approx(0.8 * 0.9)
    assert f"Pitch   {pitch:g} m/rad: {line}-handed" in to_table(found).splitlines()
    assert "Pitch" not in to_table(identification())


def test_a_window_in_words() -> None:
    found = identification(tied=(LinearType.BB, LinearType.BG))
    lines = to_table(found, label="door.csv").splitlines()
    assert lines[0] == "door.csv: Revolute joint (0.75)"
    assert lines[1] == "A frame was identified."
    assert "Angular frame B: axes fixed in the body; tied with G" in lines
    assert "Linear frame GB: axes in the ground, origin fixed in the body; tied with BB and BG" in lines
    # the columns of the rotation, not its rows
    assert "  axis 1  ( 0.000,  1.000,  0.000)      0.01 rad/s  constrained" in lines
    assert "  axis 2  (-1.000,  0.000,  0.000)      0.02 rad/s  constrained (0.90)" in lines
    assert "  axis 3  ( 0.000,  0.000,  1.000)       0.3 rad/s  free" in lines
    assert "  axis 3  ( 0.000,  0.000,  1.000)      0.25 m/s    constrained (0.97)" in lines
    assert "          axes 1 and 2 can be turned about axis 3" in lines
    assert "  origin  (0.1000, -0.2500, 0.0000) m in the body" in lines
    assert "          not determined along (0.000, 0.000, 1.000)" in lines
    assert "          the orientation is not determined" in lines
    assert "Norms   angular  G 0.04~  B 0.0391*  rad/s" in lines
    assert "Norms   linear   BB 0.5~  GB 0.25*  GG 0.125   BG 0.0625~  m/s" in lines
    assert lines[-1] == "Noise   0.12 mm, 0.081 deg; velocities over 1 sample"


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "<0.01"), (0.01, "0.01"), (0.964, "0.96"), (0.989, "0.99"), (1.0, ">0.99")]
)
def test_probabilities_have_two_digits_and_are_never_certain(value: float, text: str) -> None:
    found = identification(classes={(LinearType.GB, 1, 0): value})
    assert to_table(found).splitlines()[0] == f"Revolute joint ({text})"


def test_noise_lag_and_outliers_of_a_window_in_a_recording() -> None:
    found = identification(lag=12, poses=301, outliers=(17, 41, 200))
    window = Window(100, 401, 5.0, 20.0)
    noise, lag, out = to_table(found, windows=[window]).splitlines()[-1].split("; ")
    assert noise == "Noise   0.12 mm, 0.081 deg"
    assert lag == "velocities over 12 samples (0.6 s)"
    assert out == "3 poses left out: samples 117, 141, 300"
    alone = identification(lag=12, poses=301, outliers=(17,))
    assert to_table(alone).splitlines()[-1].endswith("over 12 samples; 1 pose left out: sample 17")
    many = identification(poses=301, outliers=tuple(range(10, 18)))
    assert (
        to_table(many)
        .splitlines()[-1]
        .endswith("8 poses left out: samples 10, 11, 12, 13, 14, 15 and 2 more")
    )


@pytest.mark.parametrize(
    ("poses", "lag", "outliers", "words"),
    [
        (6, 1, (), "5 velocities say nothing"),
        (14, 1, (), None),
        (7, 1, (3,), "5 velocities say nothing"),
        (21, 4, (), "5 velocities that do not overlap say nothing"),
        (21, 12, (), "1 velocity says nothing"),
        (21, 3, (), None),
    ],
)
def test_results_say_so_if_they_say_nothing(
    poses: int, lag: int, outliers: tuple[int, ...], words: str | None
) -> None:
    found = identification(poses=poses, lag=lag, outliers=outliers)
    (window,) = strict(to_json(found))["recordings"][0]["windows"]
    if words is None:
        assert window["notes"] == []
        assert "nothing" not in to_table(found)
    else:
        (note,) = window["notes"]
        assert note.startswith(f"{words}: with 5 or fewer, ")
        assert note.endswith("Take longer windows." if lag == 1 else "Take longer windows, or a shorter lag.")
        assert note in to_table(found).splitlines()
        assert to_table(batch(found, found)).splitlines()[-1] == note  # once


@pytest.mark.parametrize("poses", [7, 13])
def test_results_say_so_if_they_say_little(poses: int) -> None:
    (note,) = identification(poses=poses).warnings
    assert note.startswith(f"{poses - 1} velocities say little: with 12 or fewer, ")


@pytest.mark.parametrize(
    ("kind", "where", "body"),
    [
        (LinearType.BB, "axes and origin fixed in the body", "body"),
        (LinearType.GG, "axes and origin fixed in the ground", "ground"),
        (LinearType.BG, "axes in the body, origin fixed in the ground", "ground"),
    ],
)
def test_bodies_of_the_frame(kind: LinearType, where: str, body: str) -> None:
    table = to_table(identification(kind))
    assert f"Linear frame {kind}: {where}\n" in table
    assert f"m in the {body}\n" in table
    assert "tied" in table  # of the angular types
    assert table.splitlines()[0] == "Revolute joint (0.75)"


@pytest.mark.parametrize(
    ("projector", "words"),
    [
        (np.zeros((3, 3)), None),
        (np.eye(3), "not determined: the origin closest to the motion is given"),
        (np.diag([1.0, 0, 0]), r"not determined along \(1\.000, 0\.000, 0\.000\)"),
        (np.diag([1.0, 0, 1]), r"not determined along \(.*\) and \(.*\)"),
    ],
)
def test_directions_of_the_position(projector: np.ndarray, words: str | None) -> None:
    table = to_table(identification(free_position=projector))
    found = re.search(r"m in the body\n +(not determined.*)\n", table)
    assert bool(found) == (words is not None)
    if found and words:
        assert re.fullmatch(words, found[1])


def test_a_twin_is_named_with_its_distance() -> None:
    words = "explains the window as well"
    assert words not in to_table(identification())
    found = identification(LinearType.GG, twin=[0.1, -0.25, 0.21])
    lines = to_table(found).splitlines()
    assert f"      or  (0.1000, -0.2500, 0.2100) m, 0.21 m away, {words}" in lines
    (window,) = strict(to_json(found))["recordings"][0]["windows"]
    assert window["linear"]["twin"] == [0.1, -0.25, 0.21]
    rows = to_table(batch(found, identification())).splitlines()
    assert "( 0.100, -0.250,  0.000)+" in rows[2]
    assert "( 0.100, -0.250,  0.000) " in rows[3]
    assert rows[-1] == "+ another origin explains the motion as well"


def test_warnings_are_spelt_out() -> None:
    assert Status.ON_BOUNDS.message in to_table(identification(status=Status.ON_BOUNDS))
    failed = to_table(blank(identification(), Status.NO_MOTION), label="a.csv")
    assert failed == f"a.csv: No result: {Status.NO_MOTION.message}"


def test_a_batch_has_a_row_per_window() -> None:
    found = batch(
        identification(tied=(LinearType.BB,)),
        blank(identification(), Status.NOT_FINITE),
        identification(LinearType.GG, (1, 1, 1), (0, 0, 1), Status.ON_BOUNDS),
    )
    windows = [Window(10 * i, 10 * i + 10, float(i), i + 0.9) for i in range(3)]
    lines = to_table(found, label="door.csv", windows=windows).splitlines()
    assert lines[0] == "door.csv: 3 windows"
    rows = [" ".join(line.split()) for line in lines[1:5]]
    assert rows[0] == "window time [s] name prob. angular linear origin [m] status"
    assert rows[1] == "0 0.00 - 0.90 Revolute joint 0.75 B~G GB~BB ( 0.100, -0.250, 0.000) OK"
    assert rows[2] == "1 1.00 - 1.90 - - - - - NOT_FINITE"
    assert rows[3].startswith("2 2.00 - 2.90 Contour rolling 0.75 B~G GG (")
    assert lines[2].index("GB~BB") == lines[4].index("GG") == lines[1].index("linear")
    assert lines[5:] == [
        "~ tied: explains the motion as well",
        f"ON_BOUNDS: {Status.ON_BOUNDS.message}",
        f"NOT_FINITE: {Status.NOT_FINITE.message}",
    ]
    assert to_table(found[:1]).splitlines()[0] == "1 window"
    with pytest.raises(ValueError, match="zip"):
        to_table(found, windows=windows[:2])


# JSON


def strict(text: str) -> Any:
    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_json_of_a_window() -> None:
    projector = np.diag([0.0, 1.0, 0.0])
    document = strict(to_json(identification(free_position=projector), label="door.csv"))
    assert document["schema"] == "reframe-jax/identification/2"
    (recording,) = document["recordings"]
    assert (recording["recording"], recording["error"], recording["notes"]) == ("door.csv", None, [])
    (window,) = recording["windows"]
    assert {key: window[key] for key in ("index", "start", "stop_time", "status", "name", "label")} == {
        "index": 0,
        "start": None,
        "stop_time": None,
        "status": "OK",
        "name": "Revolute joint",
        "label": "A",
    }
    assert window["angular"]["type"] == "B"
    assert window["angular"]["tied"] == ["G", "B"]
    assert "position" not in window["angular"]
    linear = window["linear"]
    assert (linear["type"], linear["tied"]) == ("GB", ["GB"])
    assert linear["position"] == [0.1, -0.25, 0.0]
    assert linear["free_position"] == [[0.0, 1.0, 0.0]]
    assert linear["twin"] is None
    assert linear["dof"] == [0, 0, 0]
    assert linear["free_rotation"] == [True, True, True]
    np.testing.assert_allclose(linear["axes"], Rotation.from_rotvec(QUARTER).as_matrix().T, atol=1e-15)
    assert list(window["candidates"]["angular"]) == ["G", "B"]
    assert list(window["candidates"]["linear"]) == ["BB", "GB", "GG", "BG"]
    candidate = window["candidates"]["linear"]["GG"]
    assert candidate["norm"] == 3.0
    assert candidate["free_position"] == []
    assert (candidate["on_bounds"], candidate["agreement"]) == (False, 0.5)


def test_json_of_a_batch_says_where_windows_are_and_has_no_nan() -> None:
    odd = identification()
    odd.linear.rms[2] = np.nan
    odd.candidates.linear.norm[1] = np.inf
    found = batch(odd, blank(identification(), Status.NOT_FINITE))
    windows = [Window(0, 20, 0.0, 1.9), Window(10, 30, 1.0, 2.9)]
    first, second = strict(to_json(found, windows=windows))["recordings"][0]["windows"]
    assert (first["start"], first["stop"], first["start_time"], first["stop_time"]) == (0, 20, 0.0, 1.9)
    assert first["linear"]["rms"] == [0.001, 0.002, None]
    assert first["candidates"]["linear"]["GB"]["norm"] is None
    assert (second["index"], second["start"], second["status"]) == (1, 10, "NOT_FINITE")
    assert second["message"] == Status.NOT_FINITE.message
    assert second["notes"] == []
    empty = set(first) - {"index", "start", "stop", "start_time", "stop_time", "status", "message", "notes"}
    assert {"name", "label", "probability", "noise", "lag", "angular"} < empty
    assert {second[key] for key in empty} == {None}


def test_json_says_how_sure_it_is_and_of_what() -> None:
    classes = {(LinearType.GB, 1, 0): 0.7, (LinearType.GG, 1, 0): 0.2, (LinearType.BB, 1, 1): 0.009}
    found = identification(classes=classes, lag=2, outliers=(3, 5))
    (window,) = strict(to_json(found, windows=[Window(10, 31, 1.0, 3.0)]))["recordings"][0]["windows"]
    assert window["probability"] == pytest.approx(0.9)
    assert window["class_probability"] == [
        {"type": "GB", "rotations": 1, "translations": 0, "probability": 0.7},
        {"type": "GG", "rotations": 1, "translations": 0, "probability": 0.2},
    ]
    assert window["angular"]["free_probability"] == [0.0, 0.1, 1.0]
    assert window["linear"]["free_probability"] == [0.0, 0.0, 0.03]
    assert window["noise"] == {"position": 1.2e-4, "rotation": pytest.approx(np.radians(0.081))}
    assert (window["lag"], window["refined"], window["outliers"]) == (2, True, [13, 15])
    assert "free_probability" not in window["candidates"]["linear"]["GB"]


# Probability of the name


EVERY = {(kind, n, m): 0.01 for kind in LinearType for n in range(4) for m in range(4)}


@pytest.mark.parametrize(
    ("kind", "angular", "linear", "name", "types"),
    [
        (LinearType.GB, (0, 0, 1), (0, 0, 0), "Revolute joint", LinearType),
        (LinearType.GB, (1, 1, 1), (0, 0, 0), "Spherical joint", LinearType),
        (LinearType.BB, (0, 0, 0), (0, 0, 0), "Fixed", LinearType),
        (LinearType.GG, (0, 0, 1), (0, 0, 1), "Cylinder joint", LinearType),
        (LinearType.GG, (1, 1, 1), (0, 0, 1), "Contour rolling", [LinearType.GG]),
        (LinearType.BB, (1, 1, 1), (0, 0, 1), "Unnamed: 3 rotations, 1 translation in BB", [LinearType.BB]),
        (LinearType.BB, (0, 1, 1), (1, 1, 1), "Unnamed: 2 rotations, 3 translations", LinearType),
    ],
)
def test_the_probability_of_a_name_is_that_of_all_classes_that_carry_it(
    kind: LinearType, angular: Any, linear: Any, name: str, types: Any
) -> None:
    classes = {**EVERY, **{(other, sum(angular), sum(linear)): 0.1 * (1 + other) for other in LinearType}}
    found = identification(kind, angular, linear, classes=classes)
    assert found.name == name
    assert isinstance(found.probability, float)
    assert found.probability == pytest.approx(sum(0.1 * (1 + other) for other in types))


def test_probabilities_of_a_batch() -> None:
    found = batch(identification(), blank(identification(), Status.NO_MOTION))
    np.testing.assert_array_equal(found.probability, [0.75, np.nan])
    assert batch(found, found).probability.shape == (2, 2)
    assert np.isnan(found[1].probability)


def test_windows_of_every_axis_are_counted() -> None:
    found = batch(batch(identification(), identification(LinearType.GG, (1, 1, 1), (0, 0, 1))))
    names = [window["name"] for window in to_record(found)["windows"]]
    assert names == ["Revolute joint", "Contour rolling"]


def test_unnamed_constraints_have_no_label() -> None:
    (window,) = to_record(identification(LinearType.BB, (1, 1, 1), (0, 0, 1)))["windows"]
    assert window["label"] is None
    assert window["name"] == "Unnamed: 3 rotations, 1 translation in BB"
    (window,) = to_record(identification(angular_dof=(1, 1, 1)))["windows"]
    assert (window["label"], window["name"]) == ("spherical", "Spherical joint")


def test_recordings_that_failed_stay_in_the_document() -> None:
    records = [to_record(None, label="a.csv", error="a.csv: is empty."), to_record(identification())]
    first, second = strict(to_document(records))["recordings"]
    assert (first["recording"], first["error"], first["windows"]) == ("a.csv", "a.csv: is empty.", [])
    assert second["error"] is None


# Velocities


def test_velocities_of_a_frame_are_those_of_a_particle(rng: np.random.Generator) -> None:
    """Axes in the ground, origin in the body: differences of the origin's path."""
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(0.1 * rng.normal(size=(12, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(12, 3))
    steps = rng.uniform(0.1, 0.2, 11)
    found = identification(LinearType.GB, poses=12)
    angular, _ = frame_velocities(jnp.asarray(poses), jnp.asarray(steps), found, "left")
    axes = Rotation.from_rotvec(QUARTER).as_matrix()
    turns = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    rates = Rotation.from_matrix(turns).as_rotvec() / steps[:, None]
    np.testing.assert_allclose(angular, rates @ axes, atol=1e-12)
    _, linear = frame_velocities(jnp.asarray(poses), jnp.asarray(steps), found)
    path = poses[:, :3, :3] @ found.linear.position + poses[:, :3, 3]
    np.testing.assert_allclose(linear, np.diff(path, axis=0) / steps[:, None] @ axes, atol=1e-12)


@pytest.mark.parametrize("lag", ["auto", 1, 0.3])
def test_the_rms_of_velocities_is_that_of_the_identification(lag: Any) -> None:
    """Whatever was left out of it: outliers, rest, chords that reach beyond the window."""
    made = synthetic.simulate("K", jax.random.key(3), noise=1e-3, duration=6.0, dt=0.05)
    poses = np.array(made.poses)
    poses[90:, :, :] = poses[90]
    if lag != 1:
        poses[40, :3, 3] += 0.2
    found = identify(poses, times=np.asarray(made.times), lag=lag)
    if found.refined:  # the frames of these velocities are those of the same lag, given
        found = identify(poses, times=np.asarray(made.times), lag=int(found.lag))
    steps = np.diff(np.asarray(made.times))
    velocities = frame_velocities(jnp.asarray(poses), jnp.asarray(steps), found, lag=lag)
    left_out = np.isnan(np.asarray(velocities[0])).all(axis=1)
    if lag == 1:
        assert not left_out.any()
    else:
        expected = 6 if lag == 0.3 else int(found.lag)
        assert expected > 1
        assert int(found.lag) == expected
        assert left_out[[40 - expected, 40, 100, 119]].all()
        assert not left_out[[0, 20, 41, 60]].any()
    for group, seen in zip((found.angular, found.linear), velocities, strict=True):
        np.testing.assert_allclose(np.sqrt(np.nanmean(np.square(seen), axis=0)), group.rms, rtol=1e-6)


def test_velocities_of_a_lag_that_is_none() -> None:
    with pytest.raises(ValueError, match="lag must be 'auto'"):
        frame_velocities(jnp.zeros((5, 4, 4)), jnp.ones(4), identification(poses=5), lag=-1)
