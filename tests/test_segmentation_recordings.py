"""Real recordings of tasks, segmented with nothing but the defaults."""

from pathlib import Path

import pytest

import reframe_jax as rf

DATA = Path(__file__).parent.parent.parent / "shared" / "data"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="needs the real recordings, in ../shared/data")


def segmented(name: str) -> rf.Segmentation:
    recording = rf.load_recording(DATA / f"{name}.csv")
    return rf.segment(recording.poses, times=recording.times)


@pytest.mark.parametrize(
    ("name", "constraint"),
    [
        ("kitchen_door_389", "Revolute joint"),
        ("kitchen_door_403", "Revolute joint"),
        ("kitchen_drawer_394", "Prismatic joint"),
        ("contour_a_1", "3 rotations, 1 translation in BB"),
        ("contour_b_1", "3 rotations, 1 translation in BB"),
    ],
)
def test_one_constraint_is_one_moving_segment(name: str, constraint: str) -> None:
    (segment,) = segmented(name).moving
    assert constraint in segment.name


def test_wiping_is_one_segment_between_approach_and_retreat() -> None:
    """Its authors label the wiping from 2.3 to 10.7 s; the tool touches the board a little later."""
    found = segmented("wiping_0")
    assert len(found.moving) == 3
    start, stop = (boundary.time - found.times[0] for boundary in found.boundaries[:2])
    assert 2.0 < start < 3.2
    assert 10.0 < stop < 11.0
