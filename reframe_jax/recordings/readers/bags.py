"""Poses in ROS 1 and ROS 2 bags: topics of poses, or chains of tf frames.

The library rosbags reads one message at a time, and only the numbers are kept. The standard definitions of
message types decode messages, even if the bag contains none. Times are the stamps of the headers; if messages
have no stamps, or stamps that were not set, times are those at which messages were recorded.
"""

import importlib
import io
import os
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reframe_jax.recordings.checks import drop_unfinished, leave_out_lost, make_poses
from reframe_jax.recordings.clock import sort_times
from reframe_jax.recordings.readers.reader import Entry, Reader, choose_name, import_extra, translate_errors
from reframe_jax.recordings.recording import RecordingError, Rows, check_size, listed, shown
from reframe_jax.recordings.relative import interpolate_poses, invert_poses, origin_shift
from reframe_jax.recordings.selection import Selection, flag

_TRANSFORM, _ARRAY = "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/PoseArray"
_TOPICS = (
    *(_TRANSFORM, _ARRAY, "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"),
    *("geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseWithCovariance"),
    *("geometry_msgs/msg/Pose", "geometry_msgs/msg/Transform"),
)
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class _Edge(NamedTuple):
    """The pose of a child frame in its parent frame, constant or not."""

    parent: str
    child: str
    static: bool


class _Samples:
    """Poses of a topic or of a tf edge, as compact numbers."""

    def __init__(self) -> None:
        self.stamps, self.logged = array("q"), array("q")  # ns
        self.values = array("d")  # x y z qx qy qz qw

    def add(self, path: Path, header: Any, logged: int, pose: Any) -> None:
        """Add a pose or transform, or None for a missing pose."""
        self.stamps.append(0 if header is None else 1_000_000_000 * header.stamp.sec + header.stamp.nanosec)
        check_size(path, len(self.stamps))
        self.logged.append(logged)
        if pose is None:
            self.values.extend([np.nan] * 7)
            return
        while hasattr(pose, "pose"):  # a pose with covariance contains a pose
            pose = pose.pose
        pose = getattr(pose, "transform", pose)
        moved = hasattr(pose, "translation")
        place, turn = (pose.translation, pose.rotation) if moved else (pose.position, pose.orientation)
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def rows(self, path: Path, static: bool = False) -> Rows:
        """Make rows, with the stamps as times, or the times of recording if no stamps were set."""
        stamps = np.asarray(self.stamps)
        rows = Rows(path, "message", np.arange(len(stamps)), np.asarray(self.values).reshape(-1, 7), None)
        zero = 2 * np.count_nonzero(stamps) <= len(stamps)
        if not static and (zero or (len(stamps) > 1 and not np.ptp(stamps))):
            why = "most messages have no stamp, or 0" if zero else "all messages have the same stamp"
            rows.notes.append(f"{why}: the times are those at which the messages were recorded.")
            stamps = np.asarray(self.logged)
        if stamps.any():
            rows.times = stamps
            if not static:
                rows.keep(stamps != 0, "their stamp is 0", "missing")
            first = int(rows.times.min())
            rows.origin = f"{first // 10**9}.{first % 10**9:09d}" if first else None
            rows.times = 1e-9 * (rows.times - first)
        return rows


@dataclass(frozen=True)
class _Bag:
    """An open bag: its connections with known types, and their decoded messages."""

    _reader: Any
    _decode: Callable[[bytes, str], Any]

    def connections(self, types: tuple[str, ...]) -> list[Any]:
        """Return the connections with these types that contain messages."""
        return [each for each in self._reader.connections if each.msgtype in types and each.msgcount]

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, Any]]:
        """Yield connection, time of recording in ns, and message, in the order of recording."""
        for connection, logged, data in self._reader.messages(connections=connections) if connections else ():
            known = _TF[0] if connection.msgtype in _TF else connection.msgtype
            yield connection, logged, self._decode(data, known)

    def transforms(self) -> Iterator[tuple[_Edge, int, Any]]:
        """Yield edge, time of recording in ns, and transform."""
        for connection, logged, message in self.messages(self.connections(_TF)):
            for each in message.transforms:
                pair = _plain(each.header.frame_id), _plain(each.child_frame_id)
                yield _Edge(*pair, connection.topic.endswith("tf_static")), logged, each


class _Stream(io.BufferedReader):
    """A file that is read only to its end, because a damaged bag can claim any length."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = os.fstat(self.fileno()).st_size - self.tell()
        return super().read(left if size is None or size < 0 else max(min(size, left), 0))


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path that opens such streams."""

    def open(self, mode: str = "r", *options: Any, **more: Any) -> Any:
        if mode == "rb":
            return _Stream(io.FileIO(self, "r"))
        return super().open(mode, *options, **more)


@cache
def _decoder(first: bool) -> Callable[[bytes, str], Any]:
    """Return the decoder of messages of ROS 1 or of ROS 2, with the standard definitions of their types."""
    types = importlib.import_module("rosbags.typesys")
    store = types.get_typestore(types.Stores.ROS1_NOETIC if first else types.Stores.LATEST)
    if _TF[0] not in store.fielddefs:
        store.register(types.get_types_from_msg(f"{_TRANSFORM}[] transforms", _TF[0]))
    return store.deserialize_ros1 if first else store.deserialize_cdr


@contextmanager
def _open(path: Path) -> Iterator[_Bag]:
    """Open a bag, with errors of the bag as :class:`RecordingError`."""
    first = path.suffix.lower() == ".bag"
    library = import_extra(path, "rosbags.rosbag1" if first else "rosbags.rosbag2", "bags")
    with translate_errors(path, "a whole ROS bag"), library.Reader(_BoundedPath(path)) as reader:
        yield _Bag(reader, _decoder(first))


def read_bag(path: Path, wanted: Selection) -> Rows:
    """Read the poses of a topic, or of one tf frame in another; see :class:`Reader`."""
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
    known, tf = bag.connections(_TOPICS), {each.topic for each in bag.connections(_TF)}
    names = sorted({each.topic for each in known})
    two = f"name two, {flag('from_frame')} and {flag('to_frame')}"
    if wanted.topic in tf:
        raise RecordingError(f"{path}: {wanted.topic} contains tf frames; {two}, instead of {flag('topic')}.")
    if tf and not names:
        raise RecordingError(f"{path}: has no topics of poses, but tf frames; {two}; see reframe-jax topics.")
    topic = choose_name(path, "topic", wanted.topic, names, "topics of poses")
    chosen = [each for each in known if each.topic == topic]
    if wanted.to_frame is not None and any(each.msgtype != _TRANSFORM for each in chosen):
        raise RecordingError(f"{path}: {flag('to_frame')} selects transforms, but {topic} contains poses.")
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
            f"{path}: {topic} contains arrays of {several} poses; give the number of one, {flag('body')}, "
            f"from 0 to {several - 1}."
        )
    if wanted.body is not None and not several:
        raise RecordingError(f"{path}: {topic} contains no arrays of poses; leave out {flag('body')}.")
    if len(samples) != 1:
        pairs = listed(f"{child or 'a body'} in {parent or 'no frame'}" for parent, child in samples)
        raise RecordingError(
            f"{path}: expected the poses of one frame in one other on {topic}, found {pairs}; for "
            f"transforms, name the frame, {flag('to_frame')}."
        )
    return next(iter(samples.values())).rows(path)


def _read_chain(path: Path, bag: _Bag, ground: str, body: str) -> Rows:
    """Read the poses of a tf frame in another, in two passes, so that only edges of the chain are kept.

    If several edges move, the edge with the fewest stamps gives the times, and the other edges are
    interpolated, or left out where they are unknown. For a static edge, the last transform counts.
    """
    edges = _find_chain(path, _edges(bag), _plain(ground), _plain(body))
    samples = {edge: _Samples() for edge, _ in edges}
    for edge, logged, each in bag.transforms():
        if edge in samples:
            samples[edge].add(path, each.header, logged, each)
    chain = [(edge, along, samples[edge].rows(path, edge.static)) for edge, along in edges]
    for edge, _, rows in chain:
        _clean(path, edge, rows)
    moving = [rows for edge, _, rows in chain if not edge.static]
    if not moving:
        raise RecordingError(f"{path}: all transforms between the two frames are static: nothing moves.")
    moved = [rows for rows in moving if np.ptp(rows.values, axis=0).any()]
    own = min(moved or moving, key=lambda rows: len(rows.values))
    times = np.asarray(own.times)
    poses, known = np.tile(np.eye(4), (len(times), 1, 1)), np.ones(len(times), bool)
    for edge, along, rows in chain:
        here = make_poses(rows)
        if edge.static or (rows is not own and not np.ptp(rows.values, axis=0).any()):
            here = here[-1:]
        elif rows is not own and rows.times is not None:
            shifted = rows.times + origin_shift(path, rows.origin, own.origin)
            found, seen = interpolate_poses(shifted, here, times)
            here = np.tile(np.eye(4), (len(times), 1, 1))
            here[seen], known = found, known & seen
        poses = poses @ (here if along else invert_poses(here))
    if not known.any():
        raise RecordingError(f"{path}: the moving frames of the chain have no times in common.")
    notes = [note for _, _, rows in chain for note in rows.notes]
    joined = replace(own, values=poses[:, :3].reshape(-1, 12), notes=notes)
    joined.keep(known, "another frame of the chain has no transform at that time", "relative")
    return joined


def _edges(bag: _Bag) -> dict[_Edge, int]:
    """One edge for every parent and child frame that a transform connects, with its number of transforms.

    An edge is static only if all its transforms are static; otherwise the static ones do not count.
    """
    counts: dict[tuple[str, str], list[int]] = {}
    for (*pair, static), _, _ in bag.transforms():
        counts.setdefault((pair[0], pair[1]), [0, 0])[static] += 1
    return {_Edge(*pair, static=not moving): moving or still for pair, (moving, still) in counts.items()}


def _find_chain(path: Path, edges: Iterable[_Edge], ground: str, body: str) -> list[tuple[_Edge, bool]]:
    """Return the edges from one frame to another, each with whether it leads from parent to child."""
    near: dict[str, list[tuple[str, _Edge, bool]]] = {}
    for edge in edges:
        near.setdefault(edge.parent, []).append((edge.child, edge, True))
        near.setdefault(edge.child, []).append((edge.parent, edge, False))
    frames = f"frames: {listed(sorted(near))}"
    for frame in (ground, body):
        if frame not in near:
            raise RecordingError(f"{path}: has no tf frame {shown(frame, 60)!r}; {frames}.")
    if ground == body:
        raise RecordingError(f"{path}: expected two frames, found {shown(ground, 60)!r} twice.")
    found: dict[str, list[tuple[_Edge, bool]]] = {ground: []}
    waiting = [ground]
    for frame in waiting:  # near frames first
        for other, edge, along in near[frame]:
            if other not in found:
                found[other] = [*found[frame], (edge, along)]
                waiting.append(other)
    if body not in found:
        pair = f"{shown(ground, 60)} with {shown(body, 60)}"
        raise RecordingError(f"{path}: no transforms connect {pair}; {frames}.")
    return found[body]


def _clean(path: Path, edge: _Edge, rows: Rows) -> None:
    """Leave out transforms that are incomplete, repeated, or written while tracking was lost."""
    what = f"transform of {shown(edge.child, 60)} in {shown(edge.parent, 60)}"
    drop_unfinished(rows)
    sort_times(rows)
    if not edge.static and rows.times is None:
        raise RecordingError(f"{path}: the stamps of every {what} are 0; expected times.")
    if not edge.static and rows.times is not None and len(rows.times):
        new = np.append(True, np.diff(rows.times) > 0)
        rows.keep(new, f"the stamp of a {what} is repeated", "equal_time")
        if np.mean((np.diff(rows.values, axis=0) != 0).any(axis=1)) > 0.5:  # not of rare corrections
            leave_out_lost(rows, make_poses(rows))
    fewest = 1 if edge.static else 2
    if len(rows.values) < fewest:
        raise RecordingError(f"{path}: has {len(rows.values)} usable {what}; expected {fewest} or more.")


def _plain(frame: str) -> str:
    """Return the name of a frame, without the slash that tf once wrote before it."""
    return frame.removeprefix("/")


def _contents(path: Path) -> list[Entry]:
    with _open(path) as bag:
        counts = Counter[tuple[str, str]]()
        for each in bag.connections(_TOPICS):
            counts[each.topic, each.msgtype.replace("/msg/", "/")] += each.msgcount
        found = [Entry("topic", name, f"{kind}, {count} messages") for (name, kind), count in counts.items()]
        edges = _edges(bag)
    children = {edge.child for edge in edges}
    roots = dict.fromkeys(edge.parent for edge in edges if edge.parent not in children)
    found += [Entry("from_frame", root, "tf frame without a parent") for root in roots]
    for edge, count in edges.items():
        kind = "static" if edge.static else f"{count} transforms"
        found.append(Entry("to_frame", edge.child, f"tf frame in {edge.parent}, {kind}"))
    return found


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
