"""What people and programs read, against results made by hand."""

import json
import re
from dataclasses import replace
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
from reframe_jax.identification.cautions import Caution, caution_codes, caution_sentences
from reframe_jax.identification.frames import AllCandidates, AngularFrame, Candidates, LinearFrame, PoseNoise
from reframe_jax.identification.naming import CLASS_CODES, codes_of, name_of
from reframe_jax.identification.results import Identification
from reframe_jax.identification.velocities import frame_velocities
from reframe_jax.model.table import ENTRIES
from reframe_jax.motion.checks import Status

QUARTER = (0.0, 0.0, np.pi / 2)  # axes y, -x, z


def candidates(types: int, dof: tuple[int, int, int], position: bool) -> Candidates:
    def each(value: Any) -> Any:
        return np.repeat(np.asarray(value)[None], types, axis=0)

    return Candidates(
        rotvec=each(QUARTER),
        dof=each(dof),
        rms=each([0.01, 0.02, 0.3]),
        norm=np.arange(1.0, types + 1),
        position=each([1.0, 2.0, 3.0]) if position else None,
    )


def identification(
    linear_type: LinearType = LinearType.GB,
    angular_dof: tuple[int, int, int] = (0, 0, 1),
    linear_dof: tuple[int, int, int] = (0, 0, 0),
    status: Status = Status.OK,
    free_position: Any = None,
    tied: tuple[LinearType, ...] = (),
    free: Any = ((0.0, 0.1, 1.0), (0.0, 0.0, 0.03)),
    poses: int = 21,
    scale: int = 1,
    outliers: tuple[int, ...] = (),
    entries: dict[int, float] | None = None,
    pitch: float | None = None,
) -> Identification:
    """A revolute joint about z, unless told otherwise."""
    probability = np.zeros(len(ENTRIES))
    code = int(CLASS_CODES[linear_type, sum(angular_dof), sum(linear_dof), 0])
    entries = {code: 0.75} if entries is None else entries
    for index, value in entries.items():
        probability[index] = value
    one, three = np.diag([0.0, 0.0, 1.0]), np.array
    ties = np.isin(np.arange(4), [linear_type, *tied])
    codes = caution_codes(jnp.asarray(poses - len(outliers) - 1), (jnp.ones(3), jnp.ones(3)), None, {})
    return Identification(
        angular=AngularFrame(
            type_code=np.int32(AngularType.B),
            rotvec=three(QUARTER),
            dof=three(angular_dof),
            free_probability=three(free[0]),
            rms=three([0.01, 0.02, 0.3]),
            amplitude=three([0.001, 0.002, 0.4]),
            norm=np.float64(0.0391),
            norms=three([0.04, 0.0391]),
            tied=three([True, True]),
            free_rotation=three([False, False, True]),
        ),
        linear=LinearFrame(
            type_code=np.int32(linear_type),
            rotvec=three(QUARTER),
            position=three([0.1, -0.25, 0.0]),
            dof=three(linear_dof),
            free_probability=three(free[1]),
            rms=three([0.001, 0.002, 0.25]),
            amplitude=three([1e-4, 1.1e-3, 0.32]),
            norm=np.float64(0.00794),
            norms=three([0.5, 0.25, 0.125, 0.0625]),
            tied=ties,
            free_rotation=three([True, True, True]),
            free_position=one if free_position is None else free_position,
        ),
        candidates=AllCandidates(candidates(2, angular_dof, False), candidates(4, linear_dof, True)),
        entry_code=np.int32(code if pitch is None else codes_of("screw")[0]),
        entry_probability=probability,
        pitch=np.float64(np.nan if pitch is None else pitch),
        universal_axes=np.full((2, 3), np.nan),
        noise=PoseNoise(position=np.float64(1.2e-4), rotation=np.radians(0.081)),
        scale=np.int32(scale),
        counted=~np.isin(np.arange(poses), outliers),
        status_code=np.int32(status),
        warning_codes=np.asarray(codes),
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
    ("pitch", "line"), [(0.02, "125.7 mm per turn, right"), (-0.001, "6.283 mm per turn, left")]
)
def test_a_screw_has_a_pitch(pitch: float, line: str) -> None:
    found = identification(
        angular_dof=(0, 0, 1),
        linear_dof=(0, 0, 1),
        entries=dict.fromkeys(codes_of("screw"), 0.36),
        pitch=pitch,
    )
    assert found.name == "Screw joint"
    assert found.probability == pytest.approx(0.72)
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
    assert "  axis 1  ( 0.000,  1.000,  0.000)      0.01 rad/s  constrained, RMS 1 mrad" in lines
    assert "  axis 2  (-1.000,  0.000,  0.000)      0.02 rad/s  constrained (0.90), RMS 2 mrad" in lines
    assert "  axis 3  ( 0.000,  0.000,  1.000)       0.3 rad/s  free, RMS 400 mrad" in lines
    assert "  axis 3  ( 0.000,  0.000,  1.000)      0.25 m/s    constrained (0.97), RMS 320 mm" in lines
    assert "          axes 1 and 2 are arbitrary within their plane" in lines
    assert "  origin  (0.1000, -0.2500, 0.0000) m in the body" in lines
    assert "          not determined along (0.000, 0.000, 1.000)" in lines
    assert "          all directions are equal, so these axes are arbitrary" in lines
    assert "Norms   angular  G 0.04~  B 0.0391*  rad/s" in lines
    assert "Norms   linear   BB 0.5~  GB 0.25*  GG 0.125   BG 0.0625~  m/s" in lines
    assert lines[-1] == "Noise   0.12 mm, 0.081 deg; blocks of 1 sample"


def test_a_result_is_printed_in_a_line() -> None:
    one = identification(entries={codes_of("A")[0]: 0.97})
    assert repr(one) == "<Identification: Revolute joint (probability 0.97)>"
    assert repr(batch(one, one, one)) == "<Identification of (3,) windows: 3 Revolute joint>"
    jax.make_jaxpr(lambda code: (repr(replace(one, status_code=code)), code)[1])(0)  # without an error


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "<0.01"), (0.01, "0.01"), (0.964, "0.96"), (0.989, "0.99"), (1.0, ">0.99")]
)
def test_probabilities_have_two_digits_and_are_never_certain(value: float, text: str) -> None:
    found = identification(entries={codes_of("A")[0]: value})
    assert to_table(found).splitlines()[0] == f"Revolute joint ({text})"


def test_noise_scale_and_outliers_of_a_window_in_a_recording() -> None:
    found = identification(scale=12, poses=301, outliers=(17, 41, 200))
    window = Window(100, 401, 5.0, 20.0)
    noise, scale, out = to_table(found, windows=[window]).splitlines()[-1].split("; ")
    assert noise == "Noise   0.12 mm, 0.081 deg"
    assert scale == "blocks of 12 samples (0.6 s)"
    assert out == "3 poses left out: samples 117, 141, 300"
    single = identification(scale=12, poses=301, outliers=(17,))
    assert to_table(single).splitlines()[-1].endswith("blocks of 12 samples; 1 pose left out: sample 17")
    many = identification(poses=301, outliers=tuple(range(10, 18)))
    assert (
        to_table(many)
        .splitlines()[-1]
        .endswith("8 poses left out: samples 10, 11, 12, 13, 14, 15 and 2 more")
    )


@pytest.mark.parametrize("poses", [6, 13])
def test_few_velocities_are_pointed_out(poses: int) -> None:
    found = identification(poses=poses)
    (window,) = strict(to_json(found))["recordings"][0]["windows"]
    (note,) = window["notes"]
    assert note.startswith(f"The window has only {poses} poses ({poses - 1} steps)")
    assert note in to_table(found).splitlines()
    assert to_table(batch(found, found)).splitlines()[-1] == note  # once
    assert identification(poses=14).warnings == []


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
        (np.eye(3), "any position is valid; the one closest to the motion is given"),
        (np.diag([1.0, 0, 0]), r"not determined along \(1\.000, 0\.000, 0\.000\)"),
        (np.diag([1.0, 0, 1]), r"not determined along \(.*\) and \(.*\)"),
    ],
)
def test_directions_of_the_position(projector: np.ndarray, words: str | None) -> None:
    table = to_table(identification(free_position=projector))
    found = re.search(r"m in the body\n +(not determined.*|any position.*)\n", table)
    assert bool(found) == (words is not None)
    if found and words:
        assert re.fullmatch(words, found[1])


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
        "~ tied: fits equally well",
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
    assert document["schema"] == "reframe-jax/identification/3"
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
    assert linear["amplitude"] == [1e-4, 1.1e-3, 0.32]
    assert window["angular"]["amplitude"] == [0.001, 0.002, 0.4]
    assert linear["dof"] == [0, 0, 0]
    assert linear["free_rotation"] == [True, True, True]
    np.testing.assert_allclose(linear["axes"], Rotation.from_rotvec(QUARTER).as_matrix().T, atol=1e-15)
    assert list(window["candidates"]["angular"]) == ["G", "B"]
    assert list(window["candidates"]["linear"]) == ["BB", "GB", "GG", "BG"]
    candidate = window["candidates"]["linear"]["GG"]
    assert candidate["norm"] == 3.0
    assert set(candidate) == {"rotvec", "axes", "dof", "rms", "norm", "position"}


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
    assert {"name", "label", "probability", "noise", "scale", "angular"} < empty
    assert {second[key] for key in empty} == {None}


def test_json_says_how_sure_it_is_and_of_what() -> None:
    first, second = codes_of("A")
    found = identification(
        entries={first: 0.2, second: 0.7, codes_of("K")[0]: 0.009}, scale=2, outliers=(3, 5)
    )
    (window,) = strict(to_json(found, windows=[Window(10, 31, 1.0, 3.0)]))["recordings"][0]["windows"]
    assert window["probability"] == pytest.approx(0.9)
    hinge = {"name": "Revolute joint", "label": "A"}
    assert window["alternatives"] == [
        {**hinge, "type": str(ENTRIES[second].kind), "probability": 0.7},
        {**hinge, "type": str(ENTRIES[first].kind), "probability": 0.2},
    ]
    assert window["angular"]["free_probability"] == [0.0, 0.1, 1.0]
    assert window["linear"]["free_probability"] == [0.0, 0.0, 0.03]
    assert window["noise"] == {"position": 1.2e-4, "rotation": pytest.approx(np.radians(0.081))}
    assert (window["scale"], window["outliers"]) == (2, [13, 15])
    assert "free_probability" not in window["candidates"]["linear"]["GB"]


# Probability of the name


@pytest.mark.parametrize(
    ("kind", "angular", "linear", "name"),
    [
        (LinearType.GB, (0, 0, 1), (0, 0, 0), "Revolute joint"),
        (LinearType.GB, (1, 1, 1), (0, 0, 0), "Spherical joint"),
        (LinearType.BB, (0, 0, 0), (0, 0, 0), "Fixed"),
        (LinearType.GG, (0, 0, 1), (0, 0, 1), "Cylinder joint"),
        (LinearType.GG, (1, 1, 1), (0, 0, 1), "Contour rolling"),
        (LinearType.BB, (1, 1, 1), (0, 0, 1), "Unnamed: 3 rotations, 1 translation in BB"),
    ],
)
def test_the_probability_of_a_name_is_that_of_all_entries_with_it(
    kind: LinearType, angular: Any, linear: Any, name: str
) -> None:
    entries = {code: 0.001 * (1 + code) for code in range(len(ENTRIES))}
    found = identification(kind, angular, linear, entries=entries)
    assert found.name == name
    assert isinstance(found.probability, float)
    expected = sum(entries[code] for code in range(len(ENTRIES)) if name_of(code) == name)
    assert found.probability == pytest.approx(expected)


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


def test_velocities_at_outliers_are_unknown() -> None:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3] = np.arange(12)
    velocities = frame_velocities(jnp.asarray(poses), jnp.ones(11), identification(poses=12, outliers=(4,)))
    for group in velocities:
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(group).all(axis=1)), [3, 4])


def test_an_explanation_says_how_far_axes_give() -> None:
    lines = identification(linear_dof=(0, 0, 1)).explain().splitlines()
    assert lines[0].startswith("The body moves like a sleeve on a rod")
    assert lines[1] == (
        "Along the constrained axes the RMS displacement is at most 1.1 mm and 2 mrad; "
        "along the free axes it is up to 320 mm and 400 mrad."
    )
    assert lines[2].startswith("The axis passes through")
    assert lines[2].endswith("Any point on this axis is equally valid.")


@pytest.mark.parametrize(
    ("projector", "sentence"),
    [
        (np.diag([0.0, 1, 0]), "Any point on the line through it along (0.00, 1.00, 0.00) is equally valid."),
        (
            np.diag([0.0, 1, 1]),
            "Any point of the plane through it perpendicular to (1.00, 0.00, 0.00) is equally valid.",
        ),
    ],
)
def test_an_explanation_names_the_points_that_are_equally_valid(projector: np.ndarray, sentence: str) -> None:
    found = identification(
        LinearType.GB,
        linear_dof=(0, 0, 1),
        free_position=projector,
        entries={int(CLASS_CODES[LinearType.GB, 1, 1, 0]): 0.75},
    )
    found = replace(found, entry_code=np.int32(-1))
    line = next(line for line in found.explain().splitlines() if line.startswith("A point of the contact is"))
    assert line.endswith(sentence)


@pytest.mark.parametrize(
    ("kind", "tied", "words"),
    [
        (LinearType.GB, LinearType.BB, "the axes of translation are fixed"),
        (LinearType.GB, LinearType.GG, "the point is fixed"),
        (LinearType.GB, LinearType.BG, "the axes of translation and the point are fixed"),
    ],
)
def test_an_explanation_says_which_part_of_the_frame_is_unclear(
    kind: LinearType, tied: LinearType, words: str
) -> None:
    found = replace(identification(kind, linear_dof=(0, 0, 1), tied=(tied,)), entry_code=np.int32(-1))
    text = found.explain()
    assert text.startswith(
        "This combination of free axes has no common name: 1 rotation, 1 translation in GB"
    )
    assert f"it is not clear whether {words} in the ground or in the body" in text
    assert f"(types {kind} and {tied} fit equally well)" in text


@pytest.mark.parametrize(
    ("code", "sentence"),
    [
        (Caution.IMPROBABLE, "The name is uncertain (probability 0.30). Record a larger motion"),
        (Caution.IMPROBABLE | Caution.FEW_VELOCITIES, "The name is uncertain (probability 0.30)."),
        (
            Caution.IMPROBABLE_ASSUMED | Caution.FEW_VELOCITIES,
            "Other constraints fit better than the assumed one (probability 0.30).",
        ),
        (Caution.NOISY_SCALE, "At a chosen time scale, the motion is less than 6 times the noise"),
    ],
)
def test_advice_on_an_improbable_name_depends_on_the_recording(code: Caution, sentence: str) -> None:
    last = caution_sentences(int(code), 5, ([0.0] * 3, [0.0] * 3), 0.3)[-1]
    assert last.startswith(sentence)
    assert ("larger motion" in last) == (code == Caution.IMPROBABLE)
