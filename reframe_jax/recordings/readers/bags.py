"""Poses in ROS 1 and ROS 2 bags: topics of poses, or a chain of tf frames.

Bags are read with the library rosbags, message by message; only numbers are kept. Messages are decoded by
the standard definitions of their types, whether or not the bag holds any. Times are the stamps of the
headers; where messages have none, or nobody set them, the times at which they were recorded.
"""

import importlib
import io
import os
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name, import_extra, translate_errors
from reframe_jax.recordings.readers.transforms import Edge, chain_rows, describe_frames
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import MOST_ROWS, Rows, shown
from reframe_jax.recordings.selection import Selection, flag

__all__ = ["BAG", "read_bag"]

_POSE = "geometry_msgs/msg/PoseStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_PLAIN_POSE, _PLAIN_TRANSFORM = "geometry_msgs/msg/Pose", "geometry_msgs/msg/Transform"  # without stamps
_ARRAY = "geometry_msgs/msg/PoseArray"
_TOPICS = (
    *(_POSE, "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry", _TRANSFORM),
    *(_ARRAY, _PLAIN_POSE, _PLAIN_TRANSFORM, "geometry_msgs/msg/PoseWithCovariance"),
)
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_WHOLE = "a whole ROS bag"


class _Samples:
    """Poses of a topic or of a tf edge, as compact numbers."""

    def __init__(self) -> None:
        self.stamps, self.logged = array("q"), array("q")  # ns
        self.values = array("d")  # x y z qx qy qz qw

    def add(self, path: Path, header: Any, logged: int, pose: Any) -> None:
        """Add a pose or transform, or None where it is missing."""
        if len(self.stamps) == MOST_ROWS:
            raise RecordingError(f"{path}: has more than {MOST_ROWS} poses; cut the recording into files.")
        self.stamps.append(0 if header is None else 1_000_000_000 * header.stamp.sec + header.stamp.nanosec)
        self.logged.append(logged)
        if pose is None:
            self.values.extend([np.nan] * 7)
            return
        while hasattr(pose, "pose"):  # with a covariance, the pose of a pose
            pose = pose.pose
        pose = getattr(pose, "transform", pose)
        moved = hasattr(pose, "translation")
        place, turn = (pose.translation, pose.rotation) if moved else (pose.position, pose.orientation)
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))


class _Bag:
    """An open bag: its connections of known types, and their decoded messages."""

    def __init__(self, reader: Any, decode: Callable[[bytes, str], Any]) -> None:
        self._reader, self._decode = reader, decode

    def connections(self, types: tuple[str, ...]) -> list[Any]:
        """Connections of these types that hold messages."""
        return [each for each in self._reader.connections if each.msgtype in types and each.msgcount]

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, Any]]:
        """Connection, time of recording in ns, and message, in the order of recording."""
        for connection, logged, data in self._reader.messages(connections=connections) if connections else ():
            known = _TF[0] if connection.msgtype in _TF else connection.msgtype
            yield connection, logged, self._decode(data, known)


class _Stream(io.BufferedReader):
    """A file of which no more is read than there is: a damaged bag may claim any length."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = os.fstat(self.fileno()).st_size - self.tell()
        return super().read(left if size is None or size < 0 else max(min(size, left), 0))


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose files open as such streams."""

    def open(self, mode: str = "r", *options: Any, **more: Any) -> Any:
        if mode == "rb":
            return _Stream(io.FileIO(self, "r"))
        return super().open(mode, *options, **more)


@cache
def _decoder(first: bool) -> Callable[[bytes, str], Any]:
    """Decodes messages of ROS 1, or of ROS 2, by the standard definitions of their types."""
    types = importlib.import_module("rosbags.typesys")
    store = types.get_typestore(types.Stores.ROS1_NOETIC if first else types.Stores.LATEST)
    if _TF[0] not in store.fielddefs:
        store.register(types.get_types_from_msg(f"{_TRANSFORM}[] transforms", _TF[0]))
    decode: Callable[[bytes, str], Any] = store.deserialize_ros1 if first else store.deserialize_cdr
    return decode


@contextmanager
def _open(path: Path) -> Iterator[_Bag]:
    """Open a bag; whatever is wrong with it is a :class:`RecordingError`."""
    first = path.suffix.lower() == ".bag"
    library = import_extra(path, "rosbags.rosbag1" if first else "rosbags.rosbag2", "bags")
    with translate_errors(path, _WHOLE), library.Reader(_BoundedPath(path)) as reader:
        yield _Bag(reader, _decoder(first))


def read_bag(path: Path, wanted: Selection) -> Rows:
    """Read a topic, or the motion of one tf frame in another."""
    frames = wanted.from_frame, wanted.to_frame
    with _open(path) as bag:
        if wanted.topic is None and frames != (None, None):
            if None in frames:
                raise RecordingError(f"{path}: expected both {flag('from_frame')} and {flag('to_frame')}.")
            return _read_chain(path, bag, str(frames[0]), str(frames[1]))
        if wanted.from_frame is not None:
            raise RecordingError(
                f"{path}: expected either {flag('topic')} or {flag('from_frame')}, not both: the ground of a "
                "topic is the frame in its headers."
            )
        return _read_topic(path, bag, wanted)


def _read_topic(path: Path, bag: _Bag, wanted: Selection) -> Rows:
    """All poses of a topic."""
    known = bag.connections(_TOPICS)
    names = sorted({each.topic for each in known})
    if wanted.topic in {each.topic for each in bag.connections(_TF)}:
        raise RecordingError(
            f"{path}: {wanted.topic} holds tf frames; name two, {flag('from_frame')} and {flag('to_frame')}, "
            f"instead of {flag('topic')}."
        )
    if not names and bag.connections(_TF):
        raise RecordingError(
            f"{path}: has no topics of poses, but tf frames; name two, {flag('from_frame')} and "
            f"{flag('to_frame')}; reframe-jax topics lists them."
        )
    topic = choose_name(path, "topic", wanted.topic, names, "topics of poses")
    chosen = [each for each in known if each.topic == topic]
    if wanted.to_frame is not None and any(each.msgtype != _TRANSFORM for each in chosen):
        raise RecordingError(f"{path}: {flag('to_frame')} selects among transforms; {topic} holds poses.")
    samples: dict[tuple[str, str], _Samples] = {}
    several = 0
    for connection, logged, message in bag.messages(chosen):
        header, child = getattr(message, "header", None), _plain(getattr(message, "child_frame_id", ""))
        if wanted.to_frame is not None and child != _plain(wanted.to_frame):
            continue
        pose = message
        if connection.msgtype == _ARRAY:
            several = max(several, len(message.poses))
            number = int(wanted.body) if wanted.body and wanted.body.isdecimal() else 0
            pose = message.poses[number] if number < len(message.poses) else None
        pair = _plain(getattr(header, "frame_id", "")), child
        samples.setdefault(pair, _Samples()).add(path, header, logged, pose)
    numbers = [str(number) for number in range(several)]
    if several and wanted.body not in (numbers if several > 1 else [None, *numbers]):
        raise RecordingError(
            f"{path}: {topic} holds arrays of {several} poses; give the number of one, {flag('body')}, "
            f"from 0 to {several - 1}."
        )
    if wanted.body is not None and not several:
        raise RecordingError(f"{path}: {topic} holds no arrays of poses; leave out {flag('body')}.")
    if len(samples) != 1:
        pairs = shown(
            ", ".join(f"{child or 'a body'} in {parent or 'no frame'}" for parent, child in samples)
        )
        raise RecordingError(
            f"{path}: expected the poses of one frame in one other on {topic}, found {pairs or 'none'}; of "
            f"transforms, name the frame, {flag('to_frame')}."
        )
    return _rows(path, next(iter(samples.values())))


def _rows(path: Path, samples: _Samples, static: bool = False) -> Rows:
    """Rows with the times of their stamps, or of their recording if nobody set the stamps."""
    stamps = np.asarray(samples.stamps)
    rows = Rows(
        path, "message", np.arange(len(stamps)), np.asarray(samples.values).reshape(-1, 7), None, seconds=1.0
    )
    never_set = not stamps.any() or (len(stamps) > 1 and not np.ptp(stamps))
    if never_set and not static:
        rows.notes.append(
            f"the messages have no stamps, or {'0' if not stamps.any() else 'all the same'}: the times are "
            "those at which they were recorded."
        )
        stamps = np.asarray(samples.logged)
    if not stamps.any():
        return rows
    rows.times = stamps
    if not static:
        rows.keep(stamps != 0, "their stamp is 0", "missing")
    first = int(rows.times.min())
    rows.origin = f"{first // 10**9}.{first % 10**9:09d}" if first else None
    rows.times = 1e-9 * (rows.times - first)
    return rows


def _read_chain(path: Path, bag: _Bag, ground: str, body: str) -> Rows:
    """Poses of a tf frame in another; reads the bag twice, so that only the edges between are kept."""
    edges = _edges(bag)
    chain = Edge.chain(path, edges, _plain(ground), _plain(body))
    samples = {(edge.parent, edge.child): (edge.static, _Samples()) for edge, _ in chain}
    for connection, logged, message in bag.messages(bag.connections(_TF)):
        for each in message.transforms:
            static, kept = samples.get(_pair(each), (None, None))
            if kept is not None and static == _is_static(connection):
                kept.add(path, each.header, logged, each)
    rows = {pair: _rows(path, kept, static) for pair, (static, kept) in samples.items()}
    return chain_rows(path, [(edge, along, rows[edge.parent, edge.child]) for edge, along in chain])


def _edges(bag: _Bag) -> list[Edge]:
    """All pairs of frames; those that are published as static and moving are moving."""
    counts: dict[tuple[str, str], list[int]] = {}
    for connection, _, message in bag.messages(bag.connections(_TF)):
        static = _is_static(connection)
        for each in message.transforms:
            counts.setdefault(_pair(each), [0, 0])[static] += 1
    return [
        Edge(parent, child, static=not moving, count=moving or still)
        for (parent, child), (moving, still) in counts.items()
    ]


def _pair(transform: Any) -> tuple[str, str]:
    """The names of the parent and the child of a transform."""
    return _plain(transform.header.frame_id), _plain(transform.child_frame_id)


def _is_static(connection: Any) -> bool:
    return bool(connection.topic.endswith("tf_static"))


def _plain(frame: str) -> str:
    """The name of a frame; tf once wrote a slash before it."""
    return frame.removeprefix("/")


def _contents(path: Path) -> list[Entry]:
    with _open(path) as bag:
        counts: dict[tuple[str, str], int] = {}
        for each in bag.connections(_TOPICS):
            key = each.topic, each.msgtype.replace("/msg/", "/")
            counts[key] = counts.get(key, 0) + each.msgcount
        found = [
            Entry("topic", topic, f"{kind}, {count} messages") for (topic, kind), count in counts.items()
        ]
        return found + [Entry(*each) for each in describe_frames(_edges(bag))]


def _recognises(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    magic = {".bag": b"#ROSBAG V", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3\0"}
    return head.startswith(magic[path.suffix.lower()])


BAG = Reader(
    name="a ROS bag",
    suffixes=(".bag", ".mcap", ".db3", "/"),
    recognises=_recognises,
    read=read_bag,
    options=frozenset({"topic", "from_frame", "to_frame", "in_body", "body", "quaternion", "unit"}),
    contents=_contents,
)
