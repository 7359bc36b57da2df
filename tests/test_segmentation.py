"""Sequences of simulated constraints: number of segments, boundaries, classes, labels."""

from functools import cache
from itertools import pairwise

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.segmentation.blocks import make_blocks, merge_blocks, scale_chords
from reframe_jax.segmentation.chords import cut_chords, local_paths, track_poses
from reframe_jax.segmentation.partition import _cheapest, _join_motionless, _too_short
from reframe_jax.segmentation.spans import LONGEST, fit_spans, span_costs
from reframe_jax.simulation.motions import PoseErrors, disturb, random_motion
from reframe_jax.simulation.sequences import SequenceSimulation, simulate_sequence

DT = 0.01
NOISE = {
    "encoder": PoseErrors(sigma=1e-5),
    "markers": PoseErrors(sigma=2e-4, rotation_ratio=5.0),
}


@cache
def exact(constraints: tuple[str, ...], seed: int, excitation: str = "exciting") -> SequenceSimulation:
    return simulate_sequence(constraints, jax.random.key(seed), dt=DT, excitation=excitation)


def measured(simulation: SequenceSimulation, noise: str, seed: int = 0) -> np.ndarray:
    return np.asarray(disturb(simulation.exact_poses, jax.random.key(seed), NOISE[noise], DT))


PAIRS = [
    (("A", "unconstrained"), "Revolute joint", "Unconstrained"),
    (("K", "B"), "Pin-plane contact", "Prismatic joint"),
    (("F", "L"), "Planar contour rolling", "Plane-pin contact"),
]


@pytest.mark.parametrize("noise", sorted(NOISE))
@pytest.mark.parametrize(("constraints", "first", "second"), PAIRS)
def test_two_constraints_are_told_apart(
    constraints: tuple[str, str], first: str, second: str, noise: str
) -> None:
    truth = exact(constraints, 3)
    found = rf.segment(measured(truth, noise), dt=DT)
    assert [segment.name for segment in found.segments] == [first, second]
    (boundary,) = found.boundaries
    assert abs(boundary.index - truth.boundaries[0]) <= 10
    assert boundary.probability > 0.99
    assert boundary.earliest <= boundary.index <= boundary.latest
    assert boundary.time == pytest.approx(boundary.index * DT)


@pytest.mark.parametrize("noise", sorted(NOISE))
@pytest.mark.parametrize("label", ["A", "E", "K", "unconstrained"])
def test_one_constraint_is_one_segment(label: str, noise: str) -> None:
    errors = NOISE[noise]
    motion = random_motion(label, jax.random.key(5), samples=1000, dt=DT, errors=errors)
    found = rf.segment(np.asarray(motion.poses), dt=DT)
    assert len(found) == 1
    assert not found.boundaries


def test_segments_are_identified_as_if_they_had_been_cut_out() -> None:
    truth = exact(("A", "K"), 1)
    poses = measured(truth, "encoder")
    found = rf.segment(poses, dt=DT)
    cut = truth.boundaries[0]
    for segment, part in zip(found.segments, (poses[:cut], poses[cut:]), strict=True):
        alone = rf.identify(part, dt=DT)
        assert segment.identification is not None
        assert segment.name == alone.name
        # along the axis of the hinge, the origin is anywhere
        fixed = np.eye(3) - np.asarray(alone.linear.free_position)
        away = fixed @ np.asarray(segment.identification.linear.position - alone.linear.position)
        assert np.linalg.norm(away) < 2e-4


def test_a_constraint_that_comes_back_has_the_same_label() -> None:
    hinge = rf.ConstraintFrame.named("A", linear_type=rf.LinearType.GG)
    truth = simulate_sequence([hinge, "unconstrained", hinge, "A"], jax.random.key(2), dt=DT, durations=4.0)
    found = rf.segment(measured(truth, "encoder"), dt=DT)
    assert [segment.label for segment in found.moving] == [0, 1, 0, 2]
    assert np.all(np.abs(np.array([b.index for b in found.boundaries]) - truth.boundaries) <= 20)
    assert found.labels.shape == (len(truth.poses),)
    assert [int(found.labels[i]) for i in (100, 600, 1000, 1400)] == [0, 1, 0, 2]


def test_a_pause_is_no_change_and_rest_is_apart() -> None:
    poses = np.asarray(exact(("A", "unconstrained"), 3).exact_poses)[:501]
    still = np.repeat(poses[:1], 300, axis=0)
    halfway = 250
    # the body stops at an instant of its motion, and goes on
    paused = np.concatenate(
        [still, poses[:halfway], np.repeat(poses[halfway : halfway + 1], 150, axis=0), poses[halfway:]]
    )
    recording = np.asarray(disturb(paused, jax.random.key(1), NOISE["encoder"], DT))
    found = rf.segment(recording, dt=DT)
    assert [segment.name for segment in found.segments] == ["Rest", "Revolute joint"]
    assert abs(found.boundaries[0].index - 300) <= 30
    assert found.segments[0].resting
    assert found.segments[0].identification is None


def test_segments_hold_every_pose_once() -> None:
    found = rf.segment(measured(exact(("K", "B"), 3), "markers"), dt=DT)
    starts, stops = zip(*[(s.start, s.stop) for s in found.segments], strict=True)
    assert starts[0] == 0
    assert stops[-1] == len(found.times)
    assert starts[1:] == stops[:-1]
    assert [b.index for b in found.boundaries] == list(starts[1:])


def test_the_ground_frame_and_its_origin_do_not_matter() -> None:
    poses = measured(exact(("K", "B"), 3), "encoder")
    turn = np.eye(4)
    turn[:3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turn[:3, 3] = [5, -3, 2]
    here, there = (rf.segment(p, times=10 + DT * np.arange(len(p))) for p in (poses, turn @ poses))
    assert [s.name for s in here.segments] == [s.name for s in there.segments]
    assert abs(here.boundaries[0].index - there.boundaries[0].index) <= 2
    assert here.boundaries[0].time == pytest.approx(10 + DT * here.boundaries[0].index)


def test_chunks_join_without_seams() -> None:
    poses = np.asarray(exact(("F", "L"), 3).exact_poses)
    tracks = track_poses(poses, DT * np.arange(len(poses)))
    paths = local_paths(tracks, 0, len(poses))
    where = paths[:, rf.LinearType.GB, :, 0] + tracks.centre
    assert np.allclose(where, poses[:, :3, 3], atol=1e-12)
    # second differences of summed paths are those of smooth motion at the joints too
    bends = np.abs(np.diff(paths[:, rf.LinearType.BB], n=2, axis=0)).max(axis=(1, 2))
    assert bends[[382, 383, 766, 767]].max() <= bends.max()
    part = local_paths(tracks, 300, 900)
    assert np.allclose(part - part[0], paths[300:900] - paths[300], atol=1e-12)


def test_moments_of_spans_are_those_of_their_chords() -> None:
    poses = measured(exact(("F", "L"), 3), "markers")
    tracks = track_poses(poses, DT * np.arange(len(poses)))
    chords = cut_chords(tracks, 4)
    scales = scale_chords(tracks, chords)
    blocks = make_blocks(tracks, chords, scales, np.array([0, 100, 230, 600, len(poses)]))
    whole = merge_blocks(blocks, np.array([0, 2]))
    # the first component of the first moment of BB, of the chords that start and end in the first two blocks
    inside = slice(0, 230 - 4)
    own = (chords.maps[inside, 0, 0, 0] / scales.size[inside])[scales.moving[inside]] ** 2
    assert whole.linear[0, 0, 0, 0, 0] == pytest.approx(np.sum(own) / scales.sliding**2)
    assert whole.sums[0, 0, 0] == np.sum(scales.moving[inside])
    assert np.sum(whole.moving) == pytest.approx(np.sum(blocks.moving))


def test_costs_of_spans_agree_with_a_thorough_search() -> None:
    poses = measured(exact(("F", "L"), 3), "encoder")
    tracks = track_poses(poses, DT * np.arange(len(poses)))
    chords = cut_chords(tracks, 1)
    scales = scale_chords(tracks, chords)
    starts = np.append(np.arange(0, len(poses) - 25, 25), len(poses))
    blocks = make_blocks(tracks, chords, scales, starts)
    costs = span_costs(blocks, 3.0, 1.0)
    spans = [(0, 20), (3, 12), (20, len(starts) - 1), (10, 30)]
    thorough = fit_spans(blocks, [[span] for span in spans], 3.0, 1.0).cost
    quick = np.array([costs[a, b - a - 1] for a, b in spans])
    assert np.all(quick - thorough < 0.5)
    assert np.all(thorough - quick < 0.5)
    assert np.isinf(costs[-1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": None}, "times, "),
        ({"lag": 0}, "lag must be from 1 to"),
        ({"reach": -1.0}, "reach must be a positive length"),
    ],
)
def test_wrong_options_are_refused(change: dict[str, float], message: str) -> None:
    poses = np.asarray(exact(("A", "K"), 1).exact_poses)[:100]
    with pytest.raises(ValueError, match=message):
        rf.segment(poses, **({"dt": DT} | change))


def test_unusable_poses_are_refused() -> None:
    poses = np.asarray(exact(("A", "K"), 1).exact_poses)[:100].copy()
    with pytest.raises(ValueError, match="N >= 16"):
        rf.segment(poses[:10], dt=DT)
    with pytest.raises(ValueError, match="All poses of the window are equal"):
        rf.segment(np.repeat(poses[:1], 50, axis=0), dt=DT)
    with pytest.raises(ValueError, match="do not increase"):
        rf.segment(poses, dt=-DT)
    with pytest.raises(ValueError, match="call it outside"):
        jax.jit(lambda p: rf.segment(p, dt=DT).times)(poses)
    poses[3, 0, 0] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        rf.segment(poses, dt=DT)


def test_simulated_sequences_are_continuous_and_keep_their_constraints() -> None:
    truth = exact(("A", "unconstrained"), 3)
    poses = np.asarray(truth.exact_poses)
    assert truth.boundaries == (500,)
    assert len(truth.truths) == 2
    speed = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=(1, 2))
    # at rest where the one gives way to the other, and no jumps
    assert speed[[0, 499, 500, -1]].max() < 5e-3 * speed.max()
    assert np.abs(np.diff(speed)).max() < 0.1 * speed.max()
    found = rf.identify(measured(truth, "encoder")[:501], dt=DT)
    assert found.name == "Revolute joint"


def test_simulation_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="2 constraints and 3 durations"):
        simulate_sequence(["A", "B"], jax.random.key(0), durations=[1.0, 1.0, 1.0])
    with pytest.raises(KeyError, match="No constraint"):
        simulate_sequence(["A", "nothing"], jax.random.key(0), dt=0.1)


def cheapest_by_trying(
    costs: np.ndarray, moving: np.ndarray, price: float, single: np.ndarray, start: int = 0, after: int = 0
) -> float:
    """Lowest cost of a partition from ``start`` on, behind a span that began at ``after``, by trying all."""
    number = len(moving)
    if start == number:
        return 0.0
    best = np.inf
    may_skip = start > 0 and single[start] and moving[after:start].any()
    for first in (start, start + 1) if may_skip else (start,):
        for end in range(first + 1, min(number, first + costs.shape[1]) + 1):
            if first == start or moving[first:end].any():
                own = costs[first, end - first - 1] + (price if start else 0.0)
                best = min(best, own + cheapest_by_trying(costs, moving, price, single, end, first))
    return best


@pytest.mark.parametrize("seed", range(20))
def test_the_partition_is_the_cheapest_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.normal(0, 5, (6, 4))
    moving, single = rng.integers(0, 2, 6).astype(float), rng.random(6) < 0.7
    i, w = np.indices(costs.shape)
    costs = np.where(i + w < 6, costs, np.inf)
    spans = _cheapest(costs, moving, 2.0, single)
    assert spans[0, 0] == 0
    assert spans[-1, 1] == 6
    total = sum(costs[a, b - a - 1] for a, b in spans) + 2.0 * (len(spans) - 1)
    for (a, b), (c, d) in pairwise(spans):
        assert c == b or (c == b + 1 and single[b] and moving[a:b].any() and moving[c:d].any())
    assert total == pytest.approx(cheapest_by_trying(costs, moving, 2.0, single))


def test_spans_without_motion_belong_to_their_neighbours() -> None:
    moving = np.array([0.0, 1, 2, 0, 0, 3, 1, 0])
    spans = np.array([[0, 1], [1, 3], [3, 5], [5, 7], [7, 8]])
    assert _join_motionless(spans, moving).tolist() == [[0, 5], [5, 8]]
    twice = np.array([[0, 1], [1, 2], [2, 4]])
    assert _join_motionless(twice, np.array([0.0, 0, 1, 1])).tolist() == [[0, 4]]
    assert _join_motionless(spans, np.zeros(8)).tolist() == [[0, 8]]


def test_spans_of_less_than_one_motion_are_a_last_resort() -> None:
    short = _too_short(np.array([0.4, 0.4, 0.4, 0.0, 0.9]))
    assert short.shape == (5, LONGEST)
    assert short[0, :4].tolist() == [True, True, False, False]
    assert short[3, :2].tolist() == [False, True]
    # a recording that moves so little is one span
    assert not _too_short(np.array([0.3, 0.3]))[0, 1]
