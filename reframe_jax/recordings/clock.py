"""Times of the rows of a file: their unit, their order, and stamps that occur twice."""

from decimal import Decimal

import numpy as np

from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import Rows, is_path
from reframe_jax.recordings.selection import TIME_UNITS, Selection, flag

__all__ = ["drop_equal_times", "make_times", "sort_times"]

_SLOW = 0.9, 1e3  # s between samples: worth a note if they are a path, and refused
_SINCE_1970 = {"ns": 1e16, "us": 1e13, "ms": 1e10}  # in s, what stamps of these units look like
_PER_STEP = {"ns": 1e5, "us": 1e2, "ms": 0.0}  # s, the shortest step that such stamps look like
_COARSE = 0.5  # part of the rows that share their time, above which the times are rounded
_OTHER_BODY, _OFTEN = 5.0, 0.2  # distance of two poses at a time in steps, and how often, of several bodies
_RESTART = 3.0  # length of the path sorted by time over that in the file, if these are two recordings


def make_times(rows: Rows, dt: float | None, wanted: Selection) -> None:
    """Set the times of the rows, s: those of the file, or multiples of the sample time.

    Raises:
        RecordingError: if there is neither, or the units contradict each other.
    """
    if dt is not None:
        count = np.arange(len(rows.values)) if rows.frames is None else rows.frames - rows.frames[:1]
        rows.times, rows.origin = count * float(dt), None
        return
    if rows.times is None:
        touches = " Separate touches of a point need no times: reframe-jax calibrate."
        hint = "" if is_path(rows.positions) else touches
        raise RecordingError(f"{rows.path}: has no times; {rows.no_times}.{hint}")
    if rows.seconds is not None and wanted.time_unit is not None:
        raise RecordingError(f"{rows.path}: states the unit of its times; leave out {flag('time_unit')}.")
    factor = rows.seconds or TIME_UNITS[wanted.time_unit or "s"]
    rows.times = rows.times * factor
    if rows.origin is not None:
        if factor != 1:
            rows.origin = f"{Decimal(rows.origin) * Decimal(f'{factor:.0e}'):f}"
        rows.notes.append(f"times count from the first sample, at {rows.origin} s.")
    if rows.seconds is None:
        _check_unit(rows, wanted)


def _check_unit(rows: Rows, wanted: Selection) -> None:
    """Refuse times that are not in the unit they are read in."""
    times = rows.times if rows.times is not None else np.empty(0)
    steps = np.diff(times[np.isfinite(times)])
    step = float(np.median(np.abs(steps))) if len(steps) else 0.0
    try:
        start = abs(float(rows.origin or 0))
    except ValueError:
        start = 0.0
    since = next((unit for unit, least in _SINCE_1970.items() if start >= least), None)
    looks = since or next(unit for unit, least in _PER_STEP.items() if step >= least)
    if wanted.time_unit is None and (step > _SLOW[1] or since):
        raise RecordingError(
            f"{rows.path}: read in s, its times are {step:.3g} s apart; they look like {looks}: give "
            f"time_unit={looks!r} (--time-unit {looks}), or the sample time, dt (--dt)."
        )
    if wanted.time_unit is None and step > _SLOW[0] and is_path(rows.positions):
        rows.notes.append(
            f"times are {step:g} s apart, though the body moves little from one to the next; if they are in "
            f"{looks}, give time_unit={looks!r} (--time-unit {looks})."
        )


def sort_times(rows: Rows) -> None:
    """Sort rows by their times, which are set, and say how many came late.

    Raises:
        RecordingError: if the file holds several recordings, one after the other.
    """
    if rows.times is None:
        return
    steps = np.diff(rows.times)
    late = np.flatnonzero(steps < 0)
    if not len(late):
        return
    order = np.argsort(rows.times, kind="stable")
    if len(late) < len(steps) / 10 and _length(rows.values[order]) > _RESTART * _length(rows.values):
        now = late[0] + 1
        raise rows.error(
            int(now),
            f"the time goes back from {rows.times[now - 1]:g} s to {rows.times[now]:g} s, and sorted by time "
            "the poses are no path: the file holds several recordings; cut it there, or give dt (--dt).",
        )
    what = f"{rows.word} {rows.where[late[0] + 1]} is" if len(late) == 1 else f"{len(late)} {rows.word}s are"
    rows.notes.append(f"{what} earlier than the {rows.word} before; all are sorted by time.")
    rows.take(order)


def _length(values: np.ndarray) -> float:
    """Length of a path in all of its numbers, in units of their spread."""
    spread = values.std(axis=0)
    moved = np.abs(np.diff(values, axis=0)) / np.where(spread > 0, spread, 1)
    return float(np.sum(moved))


def drop_equal_times(rows: Rows) -> None:
    """Keep the first row of every time, and say how many others there are.

    Raises:
        RecordingError: if the times are rounded so much that most rows share theirs, or if rows at the same
            time belong to different bodies.
    """
    if rows.times is None or len(rows.times) < 2:
        return
    again = np.append(False, np.diff(rows.times) == 0)
    if not again.any():
        return
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))
    same = again & (rows.values == rows.values[first]).all(axis=1)
    other = again & ~same
    if other.any() and not rows.times.any() and rows.origin is None:
        raise RecordingError(
            f"{rows.path}: all of its times are 0, so that nobody set them; give the sample time, dt (--dt)."
        )
    if other.sum() > _COARSE * len(again):
        raise RecordingError(
            f"{rows.path}: its {len(again)} rows have only {int(np.sum(~again))} different times; the times "
            "are rounded, or several bodies share the file: select one of them, or give the sample time, "
            "dt (--dt)."
        )
    if other.sum() > _OFTEN * len(again):
        apart = np.median(np.linalg.norm((rows.values - rows.values[first])[other], axis=1))
        step = np.median(np.linalg.norm(np.diff(rows.values[~again], axis=0), axis=1))
        if apart > _OTHER_BODY * step:
            raise rows.error(
                int(np.flatnonzero(other)[0]),
                f"another pose at the same time, {rows.times[other][0]:g} s, as in {other.sum()} rows, far "
                "from the first: the file holds several bodies; keep the rows of one.",
            )
    rows.keep(~same, "the row before is repeated", "repeated")
    other = other[~same]
    if other.any():
        rows.keep(
            ~other,
            "another pose at the same time",
            "equal_time",
            f"{other.sum()} of {len(again)} rows left out, from {rows.word} {rows.where[other][0]} on: they "
            "have the time of the row before and another pose.",
        )
