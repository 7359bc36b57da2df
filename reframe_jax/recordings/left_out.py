"""Rows that are left out as tracking was lost there, and jumps that stay, in words."""

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.recordings.lost import LostRun, find_lost_poses
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, name_rows

__all__ = ["leave_out_lost", "note_jumps"]

_WHY = {
    "origin": "the position is 0, 0, 0",
    "identity": "the pose is the identity",
    "constant": "the pose is a constant far from the others",
    "frozen": "the pose before is repeated while the body moved on",
    "end": "the last pose is repeated exactly while the body was moving",
}
_FEW, _MOST = 10, 0.5  # poses that are left, and fraction that was lost, of a recording that is refused
_JUMP, _JUMPS = 10.0, 8  # a jump over the longest of 20 steps, and jumps that are worth a sentence


def leave_out_lost(rows: Rows, poses: np.ndarray) -> np.ndarray:
    """Leave out the rows in which tracking was lost, with a note of where and why.

    Args:
        rows: the rows, with times.
        poses: (N, 4, 4), m.

    Returns:
        The poses that are left.

    Raises:
        RecordingError: if they are too few.
    """
    lost = find_lost_poses(poses, rows.times)
    reasons, where, kept = lost.reasons, rows.where, ~lost.mask
    for kind, why in _WHY.items():
        mine = reasons == kind
        if not mine.any():
            continue
        if kind == "identity" and (poses[mine, :3, 3] != 0).any():
            why = "the orientation is the identity"
        if kind in ("frozen", "end"):
            why = why.replace("pose", _repeated(poses[mine], poses[np.flatnonzero(mine) - 1]), 1)
        note = f"{name_rows(rows.word, where[mine])} left out, as tracking was lost: {why}"
        longest = max((run for run in lost.runs if run.kind == kind), key=lambda run: run.stop - run.start)
        rows.keep(
            ~np.isin(rows.where, where[mine]),
            why,
            kind,
            f"{note}{_jump(rows.word, poses, where, lost.mask, longest)}.",
        )
    if kept.sum() < _FEW and kept.sum() < _MOST * len(poses):
        raise RecordingError(
            f"{rows.path}: only {kept.sum()} of {len(poses)} poses are left; " + " ".join(rows.notes[-2:])
        )
    return poses[kept]


def _repeated(poses: np.ndarray, before: np.ndarray) -> str:
    """The part of poses (N, 4, 4) that is the same in those before."""
    same = np.isclose(poses, before, rtol=0, atol=1e-9)
    parts = {"position": same[:, :3, 3].all(), "orientation": same[:, :3, :3].all()}
    return "pose" if sum(parts.values()) != 1 else next(part for part, repeats in parts.items() if repeats)


def _jump(word: str, poses: np.ndarray, where: np.ndarray, lost: np.ndarray, run: LostRun) -> str:
    """The jump to a run of lost rows and back, as the end of a sentence."""
    before, after = np.flatnonzero(~lost[: run.start]), np.flatnonzero(~lost[run.stop :]) + run.stop
    back = f" at {word} {where[after[0]]}" if len(after) else ""
    if len(before) and run.kind not in ("frozen", "end"):
        to = f"{_length(poses[before[-1]], poses[run.start])} at {word} {where[run.start]}"
        return f"; the pose jumps {to}" + (back and f" and back{back}")
    return back and f"; the pose jumps {_length(poses[run.stop - 1], poses[after[0]])}{back}"


def _length(before: np.ndarray, after: np.ndarray) -> str:
    """The distance of two poses in words: a length, or an angle if the body stays where it is."""
    moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turned = float(np.linalg.norm(rotation_vectors(after[:3, :3] @ before[:3, :3].T)))
    if moved < 0.2 * turned * 0.3 or moved == 0:  # against a body of 0.3 m
        return f"{np.degrees(turned):.2g} deg"
    return f"{float(f'{moved:.2g}'):g} m" if moved >= 0.1 else f"{1e3 * moved:.2g} mm"


def note_jumps(rows: Rows, poses: np.ndarray) -> None:
    """Note steps that are much longer than all others, which may be lost tracking that no rule finds."""
    if rows.times is None or len(poses) < 20:
        return
    spans = np.diff(rows.times)
    late = np.maximum(spans / np.median(spans), 1)
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = np.linalg.norm(np.diff(poses[:, :3, :3], axis=0), axis=(1, 2))
    long_step = np.zeros(len(late), bool)
    for steps in (moved / late, turned / late):
        long_step |= steps > _JUMP * np.quantile(steps, 0.95) + 1e-9
    jumps = np.flatnonzero(long_step) + 1
    if not 0 < len(jumps) <= _JUMPS:
        return
    sentences, at, all_return = [], 0, True
    while at < len(jumps):
        here = jumps[at]
        sentence = f"{_length(poses[here - 1], poses[here])} at {rows.word} {rows.where[here]}"
        if at + 1 < len(jumps):
            back = jumps[at + 1]
            to, fro = (poses[k] - poses[k - 1] for k in (here, back))
            if np.linalg.norm(to + fro) < 0.5 * np.linalg.norm(to):
                sentence += f" and back at {rows.word} {rows.where[back]}"
                at += 1
        all_return &= " and back " in sentence
        sentences.append(sentence)
        at += 1
    advice = "remove these rows" if all_return else "or a marker slipped, cut the recording there"
    rows.notes.append(f"the pose jumps {', '.join(sentences)}; if tracking was lost there, {advice}.")
