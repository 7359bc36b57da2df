"""Notes about lost tracking and about jumps of the pose."""

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.recordings.lost import find_lost_poses
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, name_rows

_WHY = {
    "origin": "0, 0, 0",
    "identity": "the identity",
    "constant": "the pose is a constant distant from the others",
    "frozen": "the previous pose is repeated while the body moved on",
    "end": "the last pose is repeated exactly while the body was moving",
}
_FEW, _MOST = 10, 0.5  # fewest poses, and fewest fraction of poses, of which one must remain
_JUMP, _JUMPS = 2.5, 8  # length of jumps over the longest other step, and most jumps in a note
_CLOSE = 0.02  # m, largest position of lost poses that are close to the identity
_SIZE = 0.3  # m, of a body; converts an angle to a length
_TURN = 0.2  # length of a jump over its angle times the size, below which the angle is given


def leave_out_lost(rows: Rows, poses: np.ndarray) -> np.ndarray:
    """Leave out the rows of poses (N, 4, 4), m, in which tracking was lost, with notes; return the others.

    Raises:
        RecordingError: if too few poses remain.
    """
    lost = find_lost_poses(poses, rows.times)
    where, kept = rows.where, ~lost.mask
    for kind, why in _WHY.items():
        mine = lost.reasons == kind
        if not mine.any():
            continue
        if kind in ("origin", "identity"):
            positions = np.abs(poses[mine, :3, 3]).max()
            turns = np.abs(poses[mine, :3, :3] - np.eye(3)).max()
            part = "position" if kind == "origin" else "pose" if positions < _CLOSE else "orientation"
            exact = (positions if kind == "origin" else turns) == 0
            why = f"the {part} is {'' if exact else 'close to '}{why}"
        if kind in ("frozen", "end"):
            why = why.replace("pose", _repeated(poses[mine], poses[np.flatnonzero(mine) - 1]), 1)
        longest = max((run for run in lost.runs if run.kind == kind), key=lambda run: run.stop - run.start)
        before = np.flatnonzero(kept[: longest.start])
        after = np.flatnonzero(kept[longest.stop :]) + longest.stop
        back = f" at {rows.word} {where[after[0]]}" if len(after) else ""
        jump = ""
        if len(before) and kind not in ("frozen", "end"):
            there = (
                f"{_distance(poses[before[-1]], poses[longest.start])} at {rows.word} {where[longest.start]}"
            )
            jump = f"; the pose jumps {there}{back and ' and back' + back}"
        elif back:
            jump = f"; the pose jumps {_distance(poses[longest.stop - 1], poses[after[0]])}{back}"
        note = f"{name_rows(rows.word, where[mine])} left out, as tracking was lost: {why}{jump}."
        rows.keep(~np.isin(rows.where, where[mine]), why, kind, note)
    if kept.sum() < _FEW and kept.sum() < _MOST * len(poses):
        raise RecordingError(
            f"{rows.path}: only {kept.sum()} of {len(poses)} poses are left; " + " ".join(rows.notes[-2:])
        )
    return poses[kept]


def _repeated(poses: np.ndarray, before: np.ndarray) -> str:
    """Name the part of poses (N, 4, 4) that equals the previous poses."""
    same = np.isclose(poses, before, rtol=0, atol=1e-9)
    position, orientation = same[:, :3, 3].all(), same[:, :3, :3].all()
    return "pose" if position == orientation else "position" if position else "orientation"


def _distance(before: np.ndarray, after: np.ndarray) -> str:
    """Distance of two poses in words: a length, or an angle if the body hardly changes its position."""
    moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turned = float(np.linalg.norm(rotation_vectors(after[:3, :3] @ before[:3, :3].T)))
    if moved < _TURN * _SIZE * turned or moved == 0:
        size, unit = float(np.degrees(turned)), "deg"
    else:
        size, unit = (moved, "m") if moved >= 0.1 else (1e3 * moved, "mm")
    return f"{float(f'{size:.2g}'):g} {unit}"


def note_jumps(rows: Rows, poses: np.ndarray) -> None:
    """Add a note to ``rows`` if a few steps of poses (N, 4, 4), m, are much longer than all others."""
    if rows.times is None or len(poses) < 20:
        return
    spans = np.diff(rows.times)
    late = np.maximum(spans / np.median(spans), 1)
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = np.linalg.norm(np.diff(poses[:, :3, :3], axis=0), axis=(1, 2))
    jumps = np.zeros(len(late), bool)
    for steps in (moved / late, turned / late):
        ranked = np.sort(steps)[-_JUMPS - 1 :]
        apart = np.flatnonzero(ranked[1:] > _JUMP * ranked[:-1] + 1e-9)
        jumps |= steps > ranked[apart[0] if len(apart) else -1]
    waiting = (np.flatnonzero(jumps) + 1).tolist()
    if not 0 < len(waiting) <= _JUMPS:
        return
    sentences, all_return = [], True
    while waiting:
        here = waiting.pop(0)
        sentence = f"{_distance(poses[here - 1], poses[here])} at {rows.word} {rows.where[here]}"
        there = poses[here] - poses[here - 1]
        back = poses[waiting[0]] - poses[waiting[0] - 1] if waiting else there
        returns = np.linalg.norm(there + back) < 0.5 * np.linalg.norm(there)
        if returns:
            sentence += f" and back at {rows.word} {rows.where[waiting.pop(0)]}"
        all_return &= bool(returns)
        sentences.append(sentence)
    advice = "remove these rows" if all_return else "or a marker slipped, cut the recording there"
    rows.notes.append(f"the pose jumps {', '.join(sentences)}; if tracking was lost there, {advice}.")
