"""Chains of transforms between frames: a tree of static and moving edges, as in tf."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reframe_jax.recordings.checks import drop_unfinished, make_poses
from reframe_jax.recordings.clock import sort_times
from reframe_jax.recordings.left_out import leave_out_lost
from reframe_jax.recordings.readers.collecting import matrix_rows
from reframe_jax.recordings.readers.reader import Entry
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.relative import interpolate_poses, invert_poses, origin_shift
from reframe_jax.recordings.rows import Rows, listed, shown

__all__ = ["Edge", "chain_rows", "describe_frames"]


@dataclass(frozen=True)
class Edge:
    """The pose of a child frame in its parent frame.

    Attributes:
        parent: name of the parent frame.
        child: name of the child frame.
        static: whether the pose is constant.
        count: count of transforms.
    """

    parent: str
    child: str
    static: bool
    count: int

    @staticmethod
    def chain(path: Path, edges: Sequence["Edge"], ground: str, body: str) -> list[tuple["Edge", bool]]:
        """Return the edges from one frame to another, each with whether it leads from parent to child.

        Raises:
            RecordingError: if a frame is unknown, or if no edges connect the frames.
        """
        near: dict[str, list[tuple[str, Edge, bool]]] = {}
        for edge in edges:
            near.setdefault(edge.parent, []).append((edge.child, edge, True))
            near.setdefault(edge.child, []).append((edge.parent, edge, False))
        frames = f"frames: {listed(sorted(near))}"
        for frame in (ground, body):
            if frame not in near:
                raise RecordingError(f"{path}: has no tf frame {shown(frame, 60)!r}; {frames}.")
        if ground == body:
            raise RecordingError(f"{path}: expected two frames, found {shown(ground, 60)!r} twice.")
        waiting: deque[tuple[str, list[tuple[Edge, bool]]]] = deque([(ground, [])])
        seen = {ground}
        while waiting:
            frame, found = waiting.popleft()
            if frame == body:
                return found
            for other, edge, along in near[frame]:
                if other not in seen:
                    seen.add(other)
                    waiting.append((other, [*found, (edge, along)]))
        raise RecordingError(
            f"{path}: no transforms connect {shown(ground, 60)} with {shown(body, 60)}; {frames}."
        )


def chain_rows(path: Path, chain: Sequence[tuple[Edge, bool, Rows]]) -> Rows:
    """Compute the poses along a chain, at the stamps of its moving edge.

    If several edges move, the edge with the fewest stamps gives the times, and the poses of the other edges
    are interpolated: positions linearly, orientations along the shortest rotation. Stamps at which another
    edge is unknown are left out: before its first transform, after its last, or in a gap longer than five of
    its median steps. For a static edge, the last transform counts.

    Args:
        path: the file.
        chain: edges from the ground to the body, whether each leads from parent to child, and their poses.

    Returns:
        Rows of matrices, in the unit of the file.

    Raises:
        RecordingError: if no edge moves, or if the edges have no times in common.
    """
    for edge, _, rows in chain:
        _clean(path, edge, rows)
    moving = [rows for edge, _, rows in chain if not edge.static]
    if not moving:
        raise RecordingError(f"{path}: all transforms between the two frames are static: nothing moves.")
    own = min(moving, key=lambda rows: len(rows.values))
    times = np.asarray(own.times)
    poses, known = np.tile(np.eye(4), (len(times), 1, 1)), np.ones(len(times), bool)
    for edge, along, rows in chain:
        here = make_poses(rows)
        if edge.static:
            here = here[-1:]
        elif rows is not own and rows.times is not None:
            shifted = rows.times + origin_shift(path, rows.origin, own.origin)
            found, seen = interpolate_poses(shifted, here, times)
            here = np.tile(np.eye(4), (len(times), 1, 1))
            here[seen], known = found, known & seen
        poses = poses @ (here if along else invert_poses(here))
    if not known.any():
        raise RecordingError(f"{path}: the moving frames of the chain have no times in common.")
    values = matrix_rows(poses[:, :3, :3], poses[:, :3, 3])
    notes = [note for _, _, rows in chain for note in rows.notes]
    joined = Rows(path, own.word, own.where, values, own.times, own.origin, notes)
    joined.left_out = own.left_out
    joined.keep(known, "another frame of the chain has no transform at that time", "relative")
    return joined


def _clean(path: Path, edge: Edge, rows: Rows) -> None:
    """Leave out transforms that are incomplete, repeated, or written while tracking was lost."""
    what = f"transform of {shown(edge.child, 60)} in {shown(edge.parent, 60)}"
    drop_unfinished(rows)
    sort_times(rows)
    if not edge.static and rows.times is None:
        raise RecordingError(f"{path}: the stamps of every {what} are 0; expected times.")
    if not edge.static and rows.times is not None and len(rows.times):
        new = np.append(True, np.diff(rows.times) > 0)
        rows.keep(new, f"the stamp of a {what} is repeated", "equal_time")
        leave_out_lost(rows, make_poses(rows))
    fewest = 1 if edge.static else 2
    if len(rows.values) < fewest:
        raise RecordingError(f"{path}: has {len(rows.values)} usable {what}; expected {fewest} or more.")


def describe_frames(edges: Sequence[Edge]) -> list[Entry]:
    """List the frames of a tree, for :func:`list_contents`."""
    children = {edge.child for edge in edges}
    roots = dict.fromkeys(edge.parent for edge in edges if edge.parent not in children)
    found = [Entry("from_frame", root, "tf frame without a parent") for root in roots]
    for edge in edges:
        kind = "static" if edge.static else f"{edge.count} transforms"
        found.append(Entry("to_frame", edge.child, f"tf frame in {edge.parent}, {kind}"))
    return found
