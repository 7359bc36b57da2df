"""Sequences of simulated constraints: number of segments, boundaries, stillness, labels."""

import dataclasses
from functools import cache

import jax
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks.segmentation_cases import Sequence, move_through, simulate_sequences, simulate_single
from reframe_jax.geometry.numpy_rotations import rotation_matrices
from reframe_jax.segmentation.bank import Bank
from reframe_jax.segmentation.cells import Cells, make_cells
from reframe_jax.segmentation.chance import find_stops, with_chance
from reframe_jax.segmentation.entry import place_border
from reframe_jax.segmentation.pieces import Piece, find_pieces, join_pieces
from reframe_jax.segmentation.rows import fit_spans
from reframe_jax.segmentation.sequence import Coverage, columns_of, likeliest
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.sequences import simulate_sequence

ENCODER, MARKERS, SOFT = {"white": 1e-5}, {"white": 3e-4}, {"white": 1e-6, "soft": 5e-4}
BALL = 27  # a sequence in which a ball is followed by free motion, with 1 mm of noise
HELD = {"free": (0, 0), "pin": (1, 0), "contour": (2, 0), "ball": (3, 0), "hinge": (3, 2)} | {
    "slide": (2, 3),
    "plane": (1, 2),
    "lock": (3, 3),
}


@cache
def sequence(labels: tuple[str, ...], errors: str, seed: int = 0) -> Sequence:
    sizes = {"encoder": ENCODER, "markers": MARKERS, "soft": SOFT}[errors]
    return move_through(list(labels), np.full(len(labels), 6.0), sizes, np.random.default_rng(seed), rate=50)


def pieces_of(made: Sequence) -> tuple[Cells, list[Piece]]:
    cells = with_chance(make_cells(made.poses, float(made.times[1])))
    return cells, join_pieces(cells, find_pieces(cells))


@pytest.mark.parametrize("errors", ["encoder", "markers", "soft"])
@pytest.mark.parametrize(
    "labels", [("hinge", "free", "ball"), ("slide", "pin", "plane"), ("free", "contour", "lock", "hinge")]
)
def test_what_is_held_changes_where_the_constraint_does(labels: tuple[str, ...], errors: str) -> None:
    made = sequence(labels, errors)
    cells, pieces = pieces_of(made)
    assert [piece.held for piece in pieces] == [HELD[label] for label in labels]
    starts = np.array([piece.start for piece in pieces[1:]]) * cells.weight * cells.motion_time
    assert np.all(np.abs(starts - made.changes) < 0.4)


@pytest.mark.parametrize("number", range(2))
@pytest.mark.parametrize("label", sorted(HELD))
def test_one_constraint_stays_whole(label: str, number: int) -> None:
    cells, pieces = pieces_of(simulate_single(label, number, seed=7))
    assert [(piece.start, piece.stop) for piece in pieces] == [(0, cells.linear.shape[1])]


@pytest.fixture(scope="module")
def found() -> tuple[Sequence, rf.Segmentation]:
    made = sequence(("hinge", "free", "lock", "ball"), "encoder", 1)
    return made, rf.segment(made.poses, times=made.times)


def test_segments_have_names_and_boundaries_are_close(found: tuple[Sequence, rf.Segmentation]) -> None:
    made, segmentation = found
    names = [segment.name for segment in segmentation.segments]
    assert names == ["Revolute joint", "Unconstrained", "Still", "Spherical joint"]
    assert [segment.resting for segment in segmentation.segments] == [False, False, True, False]
    assert segmentation.segments[2].identification is None
    assert len(segmentation.moving) == 3
    for boundary, change in zip(segmentation.boundaries, made.starts[1:], strict=True):
        assert abs(boundary.time - made.times[change]) < 0.2
        assert boundary.probability > 0.99
        assert boundary.earliest <= boundary.index <= boundary.latest


def test_segments_hold_every_pose_once(found: tuple[Sequence, rf.Segmentation]) -> None:
    made, segmentation = found
    starts, stops = zip(*[(s.start, s.stop) for s in segmentation.segments], strict=True)
    assert starts[0] == 0
    assert stops[-1] == len(segmentation.times) == len(made.poses)
    assert starts[1:] == stops[:-1]
    assert [b.index for b in segmentation.boundaries] == list(starts[1:])
    assert segmentation.labels.shape == (len(made.poses),)
    assert np.all(np.diff(starts) > 0)


def test_the_ground_frame_and_its_origin_do_not_matter(found: tuple[Sequence, rf.Segmentation]) -> None:
    made, segmentation = found
    turn = np.eye(4)
    turn[:3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turn[:3, 3] = [5, -3, 2]
    there = rf.segment(turn @ made.poses, times=10 + made.times)
    assert [s.name for s in segmentation.segments] == [s.name for s in there.segments]
    for here, other in zip(segmentation.boundaries, there.boundaries, strict=True):
        assert abs(here.index - other.index) <= 2
        assert other.time == pytest.approx(10 + made.times[other.index])


def test_a_pause_is_no_change_and_stillness_at_an_end_is_a_state() -> None:
    made = sequence(("hinge",), "encoder", 2)
    still, halfway = np.repeat(made.poses[:1], 150, axis=0), 120
    pause = np.repeat(made.poses[halfway : halfway + 1], 75, axis=0)
    paused = np.concatenate([still, made.poses[:halfway], pause, made.poses[halfway:]])
    rng = np.random.default_rng(0)
    paused[:, :3, 3] += rng.normal(0, 1e-5, (len(paused), 3))
    segmentation = rf.segment(paused, dt=0.02)
    assert [segment.name for segment in segmentation.segments] == ["Still", "Revolute joint"]
    assert abs(segmentation.boundaries[0].index - 150) <= 15


def test_a_constraint_that_comes_back_has_the_same_label() -> None:
    hinge = rf.ConstraintFrame.named("A", linear_type=rf.LinearType.GG)
    truth = simulate_sequence([hinge, "unconstrained", hinge, "A"], jax.random.key(2), dt=0.02, durations=6.0)
    poses = np.asarray(disturb(truth.exact_poses, jax.random.key(0), PoseErrors(sigma=1e-5), 0.02))
    segmentation = rf.segment(poses, dt=0.02)
    assert [segment.label for segment in segmentation.moving] == [0, 1, 0, 2]
    assert [int(segmentation.labels[i]) for i in (100, 450, 750, 1050)] == [0, 1, 0, 2]


def test_noise_of_single_poses_moves_no_border() -> None:
    """A cell has less noise than a pose: of that size, most poses of a ball would be no ball."""
    made = simulate_sequences(BALL + 1, 5, motion="splines")[BALL]
    assert made.labels[:2] == ("ball", "free")
    cells, pieces = pieces_of(made)
    index, _, _ = place_border(cells, *pieces[:2])
    assert abs(made.times[index] - made.changes[0]) < 0.3


@pytest.mark.parametrize("label", ["free", "pin", "contour", "plane"])
def test_rows_are_still_by_chance_in_short_spans_only(label: str) -> None:
    """The reference motion holds nothing, even if all of the recording is under one constraint."""
    cells, _ = pieces_of(sequence((label,), "encoder", 3))
    sums = cells.references(np.array([[0, 4], [0, 16], [0, 64]]))
    short, medium, long = np.exp(sums[:, 1:, 0] / np.arange(1, 4))  # mean amplitudes of 1, 2 and 3 rows
    assert np.all(short < medium)
    assert np.all(medium <= long)
    assert short[0] < short[1] < short[2]  # one row of five parameters follows four cells
    assert short[0] < 2 * cells.floor[0]
    assert long[2] > 20 * short[0]


def test_stops_are_found_between_movements_but_not_in_smooth_motion() -> None:
    ends = np.array([6.5, 12.5, 18.5])
    part = np.clip((np.arange(26)[:, None] - ends + 5) / 5, 0, 1)  # of movements that take five cells
    speed = np.diff(np.sum(part**3 * (10 - 15 * part + 6 * part**2), axis=1))
    assert np.allclose(find_stops(speed)[:2], [7, 13], atol=0.5)
    assert len(find_stops(1 + 0.3 * np.sin(np.arange(60)))) == 0


def test_movements_with_stops_hold_rows_by_chance_for_longer() -> None:
    """Between two stops all coordinates follow one function of time; two rows fit two movements."""
    rng = np.random.default_rng(8)
    made = move_through(["free"], np.array([20.0]), ENCODER, rng, rate=50, motion="jerks", apart=(0.6, 1.2))
    cells = with_chance(make_cells(made.poses, 0.02))
    number, length = cells.linear.shape[1], round(2 / cells.weight / cells.motion_time)
    spans = np.stack([np.arange(number - length), np.arange(length, number)], axis=1)
    logs = np.log(fit_spans(cells, spans).size[:, 1, :, :2]).sum(axis=-1).min(axis=1)
    assert np.median(logs) > np.median(cells.references(spans)[:, 2, 0]) - 1.0


def test_a_segment_costs_more_in_a_longer_recording() -> None:
    """The best of more spans is larger by chance, so that a long free motion would be divided more often."""
    counts = []
    for number in range(6):
        rng = np.random.default_rng(100 + number)
        made = move_through(
            ["free"], np.array([60.0]), ENCODER, rng, rate=50, motion="jerks", apart=(0.6, 1.2)
        )
        cells = with_chance(make_cells(made.poses, 0.02))
        short = dataclasses.replace(cells, price=make_cells(made.poses[:300], 0.02).price)
        counts.append([len(join_pieces(each, find_pieces(each))) for each in (cells, short)])
    ours, theirs = np.sum(counts, axis=0)
    assert ours <= theirs - 4


@pytest.mark.parametrize("label", ["contour", "ball"])
def test_short_constraints_of_splines_are_found(label: str) -> None:
    """Motion with one independent value in 1.3 s, and seven seconds of each constraint."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        made = move_through([label, "free"], np.full(2, 7.0), ENCODER, rng, 50, "splines", (0.7, 1.8))
        assert [piece.held for piece in pieces_of(made)[1]] == [HELD[label], (0, 0)]


def test_no_piece_lives_on_the_evidence_of_a_longer_span() -> None:
    for seed in range(3):
        _, pieces = pieces_of(sequence(("plane", "lock", "free"), "encoder", seed))
        assert [piece.held for piece in pieces] == [HELD["plane"], HELD["lock"], HELD["free"]]


def test_a_slow_motion_counts_as_a_shorter_one() -> None:
    steps = np.concatenate([np.full(2400, 0.02), np.full(600, 0.004)])
    phase = np.cumsum(steps)[:, None] * np.array([1.0, 1.9, 2.7])
    poses = np.tile(np.eye(4), (len(phase), 1, 1))
    poses[:, :3, 3] = 0.1 * np.sin(3 * phase)
    poses[:, :3, :3] = rotation_matrices(0.4 * np.cos(3 * phase[:, ::-1]))
    cells = with_chance(make_cells(poses, 0.02))
    change = 2400 // cells.samples
    per_cell = np.diff(cells.progress)
    assert np.mean(per_cell[: change - 10]) > 0.8
    assert np.mean(per_cell[change + 10 :]) < 0.6


@pytest.mark.parametrize("seed", range(10))
def test_the_sequence_is_the_likeliest_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    models, cells = 4, 6
    gain, price = rng.normal(0, 3, (models, cells)), float(rng.uniform(0, 4))
    # two models that do not overlap share a column
    first = rng.integers(0, 4, models)
    last = first + rng.integers(0, 3, models)
    inside = (np.arange(cells) >= first[:, None]) & (np.arange(cells) <= last[:, None])
    columns = columns_of(first, last + 1)
    dense = np.full((cells, columns.max() + 1), -np.inf)
    for model, column in enumerate(columns):
        dense[inside[model], column] = gain[model, inside[model]]
    path = likeliest(Coverage(dense, columns, first), price)

    def total(sequence: np.ndarray) -> float:
        if any(m >= 0 and not inside[m, k] for k, m in enumerate(sequence)):
            return -np.inf
        earned = sum(gain[m, k] for k, m in enumerate(sequence) if m >= 0)
        entered = [m for k, m in enumerate(sequence) if m >= 0 and (k == 0 or sequence[k - 1] != m)]
        return float(earned - price * len(entered))

    every = np.stack(np.meshgrid(*[np.arange(-1, models)] * cells), axis=-1).reshape(-1, cells)
    assert total(path) == pytest.approx(max(total(each) for each in every))


def test_models_of_a_bank_can_be_taken_and_joined() -> None:
    bank = Bank(*(np.arange(4.0),) * len(Bank._fields))
    joined = bank.take([2]).join(bank.take([0, 1]))
    assert joined.score.tolist() == [2, 0, 1]


def test_unusable_poses_are_refused() -> None:
    poses = sequence(("hinge",), "encoder", 2).poses[:100].copy()
    with pytest.raises(ValueError, match="times, "):
        rf.segment(poses)
    with pytest.raises(ValueError, match="N >= 16"):
        rf.segment(poses[:10], dt=0.02)
    with pytest.raises(ValueError, match="All poses of the window are equal"):
        rf.segment(np.repeat(poses[:1], 50, axis=0), dt=0.02)
    with pytest.raises(ValueError, match="do not increase"):
        rf.segment(poses, dt=-0.02)
    with pytest.raises(ValueError, match="call it outside"):
        jax.jit(lambda p: rf.segment(p, dt=0.02).times)(poses)
    poses[3, 0, 0] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        rf.segment(poses, dt=0.02)


def test_simulated_sequences_are_continuous_and_keep_their_constraints() -> None:
    truth = simulate_sequence(["A", "unconstrained"], jax.random.key(3), dt=0.01)
    poses = np.asarray(truth.exact_poses)
    assert truth.boundaries == (500,)
    assert len(truth.truths) == 2
    speed = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=(1, 2))
    # at rest where the one gives way to the other, and no jumps
    assert speed[[0, 499, 500, -1]].max() < 5e-3 * speed.max()
    assert np.abs(np.diff(speed)).max() < 0.1 * speed.max()


def test_simulation_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="2 constraints and 3 durations"):
        simulate_sequence(["A", "B"], jax.random.key(0), durations=[1.0, 1.0, 1.0])
    with pytest.raises(KeyError, match="No constraint"):
        simulate_sequence(["A", "nothing"], jax.random.key(0), dt=0.1)
