"""ROS bags: topics and tf chains are read as ROS means them, from files that rosbags wrote."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_files import COVARIANCE, KINDS, ODOMETRY, POSE, START, TF, TRANSFORM, Messages, Sample, write_bag
from export_files import motion

from reframe_jax.recordings import recording as records
from reframe_jax.recordings.reading import list_contents, load_recording
from reframe_jax.recordings.recording import Recording, RecordingError
from reframe_jax.recordings.relative import interpolate_poses

STEP = 10_000_000  # ns
DELAY = 3_700_000  # ns between a stamp and the recording of it

Make = Callable[..., Path]


@pytest.fixture
def poses(rng: np.random.Generator) -> np.ndarray:
    return motion(rng)


def topic(name: str, kind: str, poses: np.ndarray, where: str = "/pose", **fields: str) -> list[Sample]:
    messages = Messages(name)
    return [
        (where, kind, messages.pose(kind, START + k * STEP, pose, **fields), START + k * STEP + DELAY)
        for k, pose in enumerate(poses)
    ]


def same(recording: Recording, poses: np.ndarray) -> None:
    np.testing.assert_allclose(recording.poses, poses, atol=1e-12)
    np.testing.assert_allclose(recording.times, 0.01 * np.arange(len(poses)), atol=1e-12)
    assert recording.origin == "1700000000.250000000"
    assert recording.notes == ("times count from the first sample, at 1700000000.250000000 s.",)


@pytest.mark.parametrize("kind", [POSE, COVARIANCE, ODOMETRY, TRANSFORM])
@pytest.mark.parametrize("name", KINDS)
def test_topics(tmp_path: Path, poses: np.ndarray, name: str, kind: str) -> None:
    path = write_bag(tmp_path, name, topic(name, kind, poses))
    same(load_recording(path), poses)
    same(load_recording(path, topic="/pose"), poses)
    described, entries = list_contents(path)
    assert entries is not None
    assert described == "a ROS bag"
    (entry,) = entries
    assert (entry.option, entry.name) == ("topic", "/pose")
    assert entry.detail == f"{kind.replace('/msg/', '/')}, 12 messages"


@pytest.mark.parametrize("name", ["a.db3", "a"])
def test_bags_without_definitions(tmp_path: Path, poses: np.ndarray, name: str) -> None:
    same(load_recording(write_bag(tmp_path, name, topic(name, POSE, poses), definitions=False)), poses)


def test_topics_are_listed_and_named(tmp_path: Path, poses: np.ndarray) -> None:
    samples = topic("a.mcap", POSE, poses) + topic("a.mcap", ODOMETRY, poses[::-1], "/odom")
    path = write_bag(tmp_path, "a.mcap", sorted(samples, key=lambda sample: sample[3]))
    same(load_recording(path, topic="/odom"), poses[::-1])
    with pytest.raises(RecordingError, match=r"name one, topic \(--topic\): /odom, /pose\."):
        load_recording(path)
    with pytest.raises(RecordingError, match="has no '/scan' among its topics of poses: /odom, /pose"):
        load_recording(path, topic="/scan")


def test_the_motion_of_two_topics(tmp_path: Path, poses: np.ndarray, rng: np.random.Generator) -> None:
    other = motion(rng)
    samples = topic("a.bag", POSE, poses) + topic("a.bag", POSE, other, "/door")
    path = write_bag(tmp_path, "a.bag", sorted(samples, key=lambda sample: sample[3]))
    same(load_recording(path, topic="/pose", in_body="/door"), np.linalg.inv(other) @ poses)


def test_units_of_a_bag_may_be_given(tmp_path: Path, poses: np.ndarray) -> None:
    scaled = poses.copy()
    scaled[:, :3, 3] *= 1000
    same(load_recording(write_bag(tmp_path, "a.mcap", topic("a.mcap", POSE, scaled)), unit="mm"), poses)


def test_messages_that_came_late_are_sorted_by_their_stamps(tmp_path: Path, poses: np.ndarray) -> None:
    samples = topic("a.mcap", POSE, poses)
    swapped = [*samples[:4], samples[5], samples[4], *samples[6:]]
    timed = [(*sample[:3], START + k * STEP) for k, sample in enumerate(swapped)]
    recording = load_recording(write_bag(tmp_path, "a.mcap", timed))
    np.testing.assert_allclose(recording.poses, poses, atol=1e-12)
    assert "message 5 is earlier than the previous message; the rows are sorted by time." in recording.notes


def test_stamps_that_nobody_set(tmp_path: Path, poses: np.ndarray) -> None:
    messages = Messages("a.mcap")
    samples = [("/pose", POSE, messages.pose(POSE, 0, pose), START + k) for k, pose in enumerate(poses)]
    path = write_bag(tmp_path, "a.mcap", samples)
    recording = load_recording(path)
    np.testing.assert_allclose(recording.times, 1e-9 * np.arange(12))
    assert recording.notes[0].endswith("the times are those at which the messages were recorded.")
    np.testing.assert_allclose(load_recording(path, dt=0.01).times, 0.01 * np.arange(12))
    samples[0] = ("/pose", POSE, messages.pose(POSE, START, poses[0]), START)  # only a few are set
    some = load_recording(write_bag(tmp_path / "some", "a.mcap", samples))
    np.testing.assert_allclose(some.times, 1e-9 * np.arange(12))


def test_a_topic_in_two_frames_is_refused(tmp_path: Path, poses: np.ndarray) -> None:
    samples = topic("a.mcap", POSE, poses)[:6] + topic("a.mcap", POSE, poses, frame="odom")[6:]
    with pytest.raises(
        RecordingError, match="one frame in one other on /pose, found a body in map, a body in odom"
    ):
        load_recording(write_bag(tmp_path, "a.mcap", samples))


def test_a_topic_of_several_transforms(tmp_path: Path, poses: np.ndarray) -> None:
    samples = topic("a.mcap", TRANSFORM, poses) + topic("a.mcap", TRANSFORM, poses[::-1], child="hand")
    path = write_bag(tmp_path, "a.mcap", sorted(samples, key=lambda sample: sample[3]))
    same(load_recording(path, topic="/pose", to_frame="hand"), poses[::-1])
    with pytest.raises(
        RecordingError, match=r"found tool in map, hand in map; for transforms, name .*\(--to\)"
    ):
        load_recording(path)
    with pytest.raises(RecordingError, match="found none"):
        load_recording(path, topic="/pose", to_frame="foot")


# tf

STATIC = [("tool", "tip"), ("map", "table")]


@pytest.fixture
def tree(tmp_path: Path, rng: np.random.Generator) -> tuple[Make, dict[tuple[str, str], np.ndarray]]:
    """Writes a bag of frames: map -> base (slow) -> tool (fast) -> tip, and map -> table; and their poses."""
    known = {edge: motion(rng, 1)[0] for edge in STATIC}
    slow = motion(rng, 7)
    known["map", "base"], known["base", "tool"] = slow, motion(rng, 60)

    def make(name: str, static: str = "/tf_static", slash: str = "") -> Path:
        messages = Messages(name)
        still = [(slash + parent, slash + child, known[parent, child]) for parent, child in STATIC]
        samples: list[Sample] = [(static, TF, messages.tf(START, still), START)]
        for k, pose in enumerate(known["map", "base"]):
            time = START + 10 * k * STEP + 1_000_000
            samples.append(("/tf", TF, messages.tf(time, [("map", "base", pose)]), time + DELAY))
        for k, pose in enumerate(known["base", "tool"]):
            time = START + k * STEP
            samples.append(
                ("/tf", TF, messages.tf(time, [(slash + "base", slash + "tool", pose)]), time + DELAY)
            )
        return write_bag(tmp_path, name, sorted(samples, key=lambda sample: sample[3]))

    return make, known


@pytest.mark.parametrize("name", KINDS)
def test_an_edge_that_moves_keeps_its_stamps(
    tree: tuple[Make, dict[tuple[str, str], np.ndarray]], name: str
) -> None:
    make, known = tree
    path = make(name, slash="/" if name == "a.bag" else "")
    same(
        load_recording(path, from_frame="base", to_frame="tip"), known["base", "tool"] @ known["tool", "tip"]
    )
    same(
        load_recording(path, from_frame="tip", to_frame="/base"),
        np.linalg.inv(known["base", "tool"] @ known["tool", "tip"]),
    )


def test_chains_of_moving_edges(tree: tuple[Make, dict[tuple[str, str], np.ndarray]]) -> None:
    """At the stamps of the slower edge, between which the faster one is interpolated."""
    make, known = tree
    recording = load_recording(make("a.mcap"), from_frame="table", to_frame="tip")
    times = 0.1 * np.arange(7) + 0.001
    tool, seen = interpolate_poses(0.01 * np.arange(60), known["base", "tool"], times)
    np.testing.assert_array_equal(seen, [*[True] * 6, False])
    expected = np.linalg.inv(known["map", "table"]) @ known["map", "base"][:6] @ tool @ known["tool", "tip"]
    np.testing.assert_allclose(recording.poses, expected, atol=1e-7)
    np.testing.assert_allclose(recording.times, times[:6] - times[0], atol=1e-12)
    assert recording.origin == "1700000000.251000000"
    assert recording.notes[0] == (
        "message 6 left out: another frame of the chain has no transform at that time."
    )


def test_frames_are_listed(tree: tuple[Make, dict[tuple[str, str], np.ndarray]]) -> None:
    _, entries = list_contents(tree[0]("a.db3"))
    assert entries is not None
    assert {(entry.option, entry.name, entry.detail) for entry in entries} == {
        ("from_frame", "map", "tf frame without a parent"),
        ("to_frame", "base", "tf frame in map, 7 transforms"),
        ("to_frame", "tool", "tf frame in base, 60 transforms"),
        ("to_frame", "tip", "tf frame in tool, static"),
        ("to_frame", "table", "tf frame in map, static"),
    }


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({}, "has no topics of poses, but tf frames; name two"),
        ({"from_frame": "map"}, r"expected both from_frame \(--from\) and to_frame \(--to\)"),
        (
            {"from_frame": "map", "to_frame": "nose"},
            "has no tf frame 'nose'; frames: base, map, table, tip, tool",
        ),
        ({"from_frame": "map", "to_frame": "map"}, "expected two frames, found 'map' twice"),
        ({"from_frame": "map", "to_frame": "table"}, "between the two frames are static: nothing moves"),
        ({"topic": "/tf"}, r"/tf contains tf frames; name two"),
        ({"topic": "/pose", "from_frame": "map"}, r"expected either topic \(--topic\) or from_frame"),
    ],
)
def test_frames_that_cannot_be_read(
    tree: tuple[Make, dict[tuple[str, str], np.ndarray]], options: dict[str, str], problem: str
) -> None:
    with pytest.raises(RecordingError, match=problem):
        load_recording(tree[0]("a.mcap"), **options)  # type: ignore[arg-type]


def test_frames_that_nothing_connects(tmp_path: Path, poses: np.ndarray) -> None:
    messages = Messages("a.mcap")
    samples = [
        ("/tf", TF, messages.tf(START + k, [("map", "a", pose), ("odom", "b", pose)]), START + k)
        for k, pose in enumerate(poses)
    ]
    with pytest.raises(RecordingError, match="no transforms connect map with b; frames: a, b, map, odom"):
        load_recording(write_bag(tmp_path, "a.mcap", samples), from_frame="map", to_frame="b")


# files that are none


@pytest.mark.parametrize("name", KINDS[:3])
@pytest.mark.parametrize("keep", [0, 60, 900])
def test_bags_cut_off(tmp_path: Path, poses: np.ndarray, name: str, keep: int) -> None:
    path = write_bag(tmp_path, name, topic(name, POSE, poses))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError) as caught:
        load_recording(path)
    assert str(caught.value).startswith(f"{path}: expected a ")
    assert "ROS bag" in str(caught.value)
    assert str(caught.value).isprintable()


def test_folders_that_are_no_bags(tmp_path: Path, poses: np.ndarray) -> None:
    path = write_bag(tmp_path, "a", topic("a", POSE, poses))
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with pytest.raises(RecordingError, match="expected a whole ROS bag; it cannot be read: "):
        load_recording(path)
    (path / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        load_recording(path)


def test_bags_without_poses(tmp_path: Path) -> None:
    messages = Messages("a.mcap")
    zero = messages.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    path = write_bag(tmp_path, "a.mcap", [("/v", "geometry_msgs/msg/Vector3", zero, START)])
    with pytest.raises(RecordingError, match="has no topics of poses"):
        load_recording(path)
    assert list_contents(path)[1] == []


def test_bags_of_too_many_poses(tmp_path: Path, poses: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "MOST_ROWS", 8)
    with pytest.raises(RecordingError, match="has more than 8 rows; divide the recording into files"):
        load_recording(write_bag(tmp_path, "a.mcap", topic("a.mcap", POSE, poses)))


def test_bags_are_streamed(tmp_path: Path, rng: np.random.Generator) -> None:
    """Of every message, 64 bytes are kept: none of the 2 KB around them."""
    count = 4000
    messages, other = Messages("a.db3"), motion(rng, 1)[0]
    samples = (
        ("/pose", POSE, messages.pose(POSE, START + k * STEP, other, frame="f" * 2000), START + k * STEP)
        for k in range(count)
    )
    path = write_bag(tmp_path, "a.db3", samples)
    load_recording(path)  # imports and caches
    tracemalloc.start()
    recording = load_recording(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(recording.times) == count
    assert peak < 1500 * count  # the blocks of checks take most of it
    assert path.stat().st_size > 2000 * count
