"""Real recordings of tasks, segmented with nothing but the defaults."""

import csv
from pathlib import Path

import numpy as np
import pytest

import reframe_jax as rf

DATA = Path(__file__).parent.parent.parent / "shared" / "data"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")


def segmented(name: str) -> rf.Segmentation:
    recording = rf.load_recording(DATA / f"{name}.csv")
    return rf.segment(recording.poses, times=recording.times)


def labelled_changes(name: str) -> np.ndarray:
    """Times at which the authors' label changes, s, except in the last tenth of a second."""
    with open(DATA / f"{name}.csv") as file:
        rows = list(csv.DictReader(file))
    phases = np.array([float(row["label"]) for row in rows])
    times = np.array([float(row["t"]) for row in rows])
    changes = times[np.flatnonzero(np.diff(phases)) + 1]
    return changes[changes < times[-1] - 0.1]


@pytest.mark.parametrize(
    ("name", "constraint"),
    [
        ("kitchen_door_389", "Revolute joint"),
        ("kitchen_door_391", "Revolute joint"),
        ("kitchen_door_403", "Revolute joint"),
        ("kitchen_drawer_394", "Prismatic joint"),
        ("kitchen_drawer_407", "Prismatic joint"),
        ("champ_microwave_with_grasp", "Revolute joint"),
        ("pouring", "Unconstrained"),
        ("contour_a_1", "Unnamed: 3 rotations, 1 translation in BB"),
        ("contour_b_1", "Unnamed: 3 rotations, 1 translation in BB"),
    ],
)
def test_one_constraint_is_one_moving_segment(name: str, constraint: str) -> None:
    assert [segment.name for segment in segmented(name).moving] == [constraint]


@pytest.mark.parametrize("name", ["grating_0", "grating_4"])
def test_grating_begins_and_ends_where_its_authors_say(name: str) -> None:
    found = segmented(name)
    edges = np.array([boundary.time for boundary in found.boundaries])
    for change in labelled_changes(name):
        assert np.abs(edges - change).min() < 0.5
    # the strokes are one segment
    longest = max(found.moving, key=lambda segment: segment.stop - segment.start)
    assert found.times[longest.stop - 1] - found.times[longest.start] > 20
    assert len(found.moving) <= 5


@pytest.mark.parametrize("name", ["wiping_0", "wiping_1"])
def test_wiping_is_one_segment_between_approach_and_retreat(name: str) -> None:
    found = segmented(name)
    edges = np.array([boundary.time for boundary in found.boundaries])
    for change in labelled_changes(name):
        assert np.abs(edges - change).min() < 0.5
    assert len(found.moving) == 3
    approach, wiping, _ = found.moving
    assert approach.label != wiping.label
