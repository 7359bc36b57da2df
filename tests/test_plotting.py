"""Pictures: what is drawn and where. How they look was judged by eye."""

import io
from typing import Any

import jax
import numpy as np
import pytest
from legible import check_legible
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from scipy.spatial.transform import Rotation

from reframe_jax import plotting
from reframe_jax.constraints.types import LinearType
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.frames import AllCandidates, AngularFrame, Candidates, LinearFrame, PoseNoise
from reframe_jax.identification.naming import CLASS_CODES
from reframe_jax.identification.results import Identification
from reframe_jax.model.table import ENTRIES
from reframe_jax.motion.checks import Status
from reframe_jax.plotting.style import FREE

TIMES = 0.1 * np.arange(9)
POSITION = np.array([0.2, 0.1, 0.0])


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(TIMES[:, None] * [0.0, 0.5, 1.0]).as_matrix()
    poses[:, :3, 3] = np.stack([TIMES, TIMES**2, 0 * TIMES], axis=1)
    return poses


def identification(
    kind: LinearType,
    angular_dof: tuple[int, ...] = (0, 0, 1),
    linear_dof: tuple[int, ...] = (0, 1, 1),
    outliers: tuple[int, ...] = (),
) -> Identification:
    candidates = Candidates(*(np.zeros((4, 3)) for _ in range(4)))
    common: dict[str, Any] = {"norm": np.float64(1), "norms": np.ones(4), "rms": np.ones(3)}
    common |= {"tied": np.zeros(4, bool), "free_rotation": np.zeros(3, bool), "rotvec": np.array([0, 0, 0.3])}
    common |= {"free_probability": np.zeros(3), "amplitude": np.ones(3)}
    return Identification(
        angular=AngularFrame(type_code=np.int32(1), dof=np.array(angular_dof), **common),
        linear=LinearFrame(
            type_code=np.int32(kind),
            dof=np.array(linear_dof),
            position=POSITION,
            free_position=np.zeros((3, 3)),
            **common,
        ),
        candidates=AllCandidates(candidates, candidates),
        entry_code=np.int32(CLASS_CODES[kind, sum(angular_dof), sum(linear_dof), 0]),
        entry_probability=np.zeros(len(ENTRIES)),
        pitch=np.float64(np.nan),
        universal_axes=np.full((2, 3), np.nan),
        noise=PoseNoise(position=np.float64(1e-9), rotation=np.float64(1e-9)),
        scale=np.int32(1),
        counted=~np.isin(np.arange(9), outliers),
        status_code=np.int32(Status.OK),
        warning_codes=np.int32(0),
    )


def draw(poses: np.ndarray, found: Identification, **options: Any) -> tuple[Figure, Any, list[Any]]:
    figure = plotting.plot_identification(poses, found, times=TIMES, **options)
    space, *graphs = figure.axes
    return figure, space, graphs


def origins(space: Any) -> np.ndarray:
    """Points drawn as dots."""
    return np.array([np.ravel(line.get_data_3d()) for line in space.lines if line.get_marker() == "o"])


@pytest.mark.parametrize("kind", LinearType)
def test_the_frame_is_drawn_where_it_is(poses: np.ndarray, kind: LinearType) -> None:
    _, space, _ = draw(poses, identification(kind))
    shown = poses[[4]] if kind == LinearType.GG else poses[[0, 4, 8]]
    moving = shown[:, :3, :3] @ POSITION + shown[:, :3, 3]
    expected = moving if kind.name[1] == "B" else np.tile(POSITION, (len(shown), 1))
    np.testing.assert_allclose(origins(space), expected, atol=1e-12)
    # two free axes are arrows, the constrained one is dashed, and all are numbered once
    assert sum(isinstance(item, Line3DCollection) for item in space.collections) == 2 * len(shown)
    dashed = [line for line in space.lines if line.get_linestyle() == "--" and len(line.get_data_3d()[0])]
    assert len(dashed) == len(shown)
    start, end = np.transpose(dashed[-1].get_data_3d())
    axes = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    along = axes[:, 0] if kind.name[0] == "G" else shown[-1, :3, :3] @ axes[:, 0]
    np.testing.assert_allclose((end - start) / np.linalg.norm(end - start), along, atol=1e-12)
    assert sorted(text.get_text() for text in space.texts) == ["1", "2", "3"]


@pytest.mark.parametrize("kind", LinearType)
def test_an_origin_on_the_body_is_joined_to_it(poses: np.ndarray, kind: LinearType) -> None:
    _, space, _ = draw(poses, identification(kind))
    names = [text.get_text() for text in space.get_legend().get_texts()]
    on_body = kind.name[1] == "B"
    assert ("path of the frame's origin" in names) is on_body
    if on_body:
        (path,) = (line for line in space.lines if line.get_linestyle() == ":")
        there = poses[:, :3, :3] @ POSITION + poses[:, :3, 3]
        np.testing.assert_allclose(np.transpose(path.get_data_3d()), there)
        ends = [np.transpose(line.get_data_3d()) for line in space.lines if line.get_linewidth() == 2.2]
        np.testing.assert_allclose(ends, np.stack([poses[:, :3, 3], there], axis=1)[[0, 4, 8]])


def test_lengths_are_equal_and_everything_fits(poses: np.ndarray) -> None:
    _, space, _ = draw(poses, identification(LinearType.BB))
    limits = np.array([space.get_xlim(), space.get_ylim(), space.get_zlim()])
    np.testing.assert_allclose(np.ptp(limits, axis=1), np.ptp(limits[0]))
    track = poses[:, :3, :3] @ POSITION + poses[:, :3, 3]
    for points in (poses[:, :3, 3], origins(space), track):
        assert (limits[:, 0] < points).all()
        assert (points < limits[:, 1]).all()
    assert [space.get_xlabel(), space.get_ylabel(), space.get_zlabel()] == ["x [m]", "y [m]", "z [m]"]


def test_text_is_legible_at_half_the_size_and_axes_have_units(poses: np.ndarray) -> None:
    found = identification(LinearType.GB, outliers=(3,))
    limits = Thresholds(angular=0.3, linear=0.2)
    figure = plotting.plot_identification(
        poses, found, times=TIMES, thresholds=limits, left_out=[0.05], title="door.csv"
    )
    check_legible(figure)
    figure.axes[1].set_ylabel("velocity")
    with pytest.raises(AssertionError):
        check_legible(figure)


@pytest.mark.parametrize(
    ("angular_dof", "linear_dof", "labels"),
    [
        ((0, 0, 1), (0, 0, 0), {"free axis of rotation", "constrained axis of BB"}),
        ((1, 1, 1), (0, 1, 1), {"free axis of linear frame BB", "constrained axis of BB"}),
        ((0, 0, 0), (1, 1, 1), {"free axis of linear frame BB"}),
    ],
)
def test_the_legend_names_what_is_there(
    poses: np.ndarray, angular_dof: tuple[int, ...], linear_dof: tuple[int, ...], labels: set[str]
) -> None:
    _, space, _ = draw(poses, identification(LinearType.BB, angular_dof, linear_dof))
    texts = {text.get_text() for text in space.get_legend().get_texts()}
    assert texts == {"path and axes of the body", "path of the frame's origin", *labels}


def test_velocities_and_thresholds(poses: np.ndarray) -> None:
    found = identification(LinearType.GB)
    _, _, (linear, angular, *_) = draw(poses, found, thresholds=Thresholds(angular=0.5, linear=0.25))
    path = poses[:, :3, :3] @ POSITION + poses[:, :3, 3]
    velocities = np.diff(path, axis=0) / 0.1 @ Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    for i, line in enumerate(linear.lines[:3]):
        np.testing.assert_allclose(line.get_xdata(), (TIMES[1:] + TIMES[:-1]) / 2)
        np.testing.assert_allclose(line.get_ydata(), velocities[:, i], atol=1e-9)
        freedom = "free" if found.linear.dof[i] else "constrained"
        assert line.get_label() == f"axis {i + 1}, {freedom}"
    for graph, level, unit in ((linear, 0.25, "m/s"), (angular, 0.5, "rad/s")):
        assert [line.get_ydata()[0] for line in graph.lines[3:]] == [-level, level]
        assert {line.get_linestyle() for line in graph.lines[3:]} == {"--"}
        assert unit in graph.get_ylabel()
        assert f"threshold {level:g} {unit}" in [text.get_text() for text in graph.get_legend().get_texts()]


def test_bars_are_amplitudes_with_the_probability_of_a_free_axis(poses: np.ndarray) -> None:
    found = identification(LinearType.GB)
    _, _, (_, _, *bars) = draw(poses, found)
    for axes, frame, unit in zip(bars, (found.linear, found.angular), ("mm", "mrad"), strict=True):
        ends = [bar.get_x() + bar.get_width() for bar in axes.patches]
        np.testing.assert_allclose(ends, 1e3 * frame.amplitude)
        assert [text.get_text() for text in axes.texts] == [f" 1000 {unit}, P(free) <0.01"] * 3
        assert f"[{unit}]" in axes.get_xlabel()


def test_without_thresholds_none_are_drawn(poses: np.ndarray) -> None:
    _, _, graphs = draw(poses, identification(LinearType.GB))
    for graph in graphs[:2]:
        assert len(graph.lines) == 3
        assert graph.get_legend() is None


@pytest.mark.parametrize(("distance", "shown"), [(0.05, 1), (50.0, 0)])
def test_outliers_are_crosses_and_do_not_spoil_the_picture(
    poses: np.ndarray, distance: float, shown: int
) -> None:
    """Those far away are in the graphs only."""
    found = identification(LinearType.GG, outliers=(5,))
    _, before, _ = draw(poses, found)
    jumps = poses.copy()
    jumps[5, :3, 3] += distance
    _, space, graphs = draw(jumps, found)
    assert space.get_xlim() == before.get_xlim()
    (crosses,) = (line for line in space.lines if line.get_marker() == "x")
    np.testing.assert_allclose(np.transpose(crosses.get_data_3d()), jumps[[5][:shown], :3, 3].reshape(-1, 3))
    assert "outliers" in {text.get_text() for text in space.get_legend().get_texts()}
    for graph in graphs[:2]:
        *lines, marks = graph.lines
        np.testing.assert_allclose(marks.get_xdata(), TIMES[[5]])
        # the steps to it and from it
        for line in lines:
            assert np.flatnonzero(np.isnan(line.get_ydata())).tolist() == [4, 5]


def test_rows_that_were_not_read_are_bars_along_the_time_axis(poses: np.ndarray) -> None:
    found = identification(LinearType.GG)
    _, _, graphs = draw(poses, found, left_out=[TIMES[2], TIMES[3]])
    for graph in graphs[:2]:
        (marks,) = (line for line in graph.lines if line.get_marker() == "|")
        np.testing.assert_allclose(marks.get_xdata(), TIMES[[2, 3]])
    assert graphs[0].get_legend().get_texts()[-1].get_text() == "rows not read"


def test_axes_have_different_colours(poses: np.ndarray) -> None:
    for dof in ((0, 0, 0), (0, 1, 1), (1, 1, 1)):
        _, _, (linear, *_) = draw(poses, identification(LinearType.GB, linear_dof=dof))
        colours = [to_hex(line.get_color()).upper() for line in linear.lines[:3]]
        assert len(set(colours)) == 3
        assert [colour in FREE for colour in colours] == [bool(free) for free in dof]


def test_titles_and_saving(poses: np.ndarray) -> None:
    figure, _, _ = draw(poses, identification(LinearType.GB, (1, 1, 1)))
    assert figure.get_suptitle() == "Pin-plane contact"
    figure, _, _ = draw(poses, identification(LinearType.GB), title="door.csv")
    assert figure.get_suptitle() == "door.csv"
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=50)
    assert file.getvalue().startswith(b"\x89PNG")


def test_only_single_windows_with_a_result_are_drawn(poses: np.ndarray) -> None:
    found = identification(LinearType.GB)
    with pytest.raises(ValueError, match="index one window first"):
        draw(poses, jax.tree.map(lambda leaf: np.asarray(leaf)[None], found))
    failed = Identification(**{**vars(found), "status_code": np.int32(Status.NO_MOTION)})
    with pytest.raises(ValueError, match="nothing to draw: All poses of the window are equal"):
        draw(poses, failed)


@pytest.mark.usefixtures("no_matplotlib")
def test_missing_matplotlib_is_explained(poses: np.ndarray) -> None:
    with pytest.raises(ImportError, match=r'pip install "reframe-jax\[plot\]"'):
        draw(poses, identification(LinearType.GB))
