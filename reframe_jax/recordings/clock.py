"""Times of the rows of a file: their unit, their order, and repeated times."""

import math
from decimal import Decimal

import numpy as np

from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.rows import EPOCH, Rows, is_path
from reframe_jax.recordings.selection import TIME_UNITS, Selection, unit_of

__all__ = ["drop_equal_times", "make_times", "sort_times"]

_SLOW, _SLOWEST = 0.9, 1e3  # s between samples: noted for a path; refused
_USUAL = 0.02  # s between samples of a usual recording
_SINCE_1970 = 3e8, 5e9  # s, clock times of recordings
_DISTANT = 10.0  # distance of the times from 0 over their span, above which a time of 0 was never set
_COARSE = 0.5  # fraction of rows with the time of another row, above which the times are rounded
_BODIES, _OFTEN = 5.0, 0.2  # distance of poses at equal times in steps, and fraction of rows: several bodies
_RESTART = 3.0  # length of the path sorted by time over its length in the file: several recordings


def make_times(rows: Rows, dt: float | None, wanted: Selection) -> None:
    """Set the times of the rows, s: the times of the file, or multiples of the sample time ``dt``, s.

    Raises:
        RecordingError: if the file has no times and there is no sample time, or if the unit is wrong.
    """
    if dt is not None:
        count = np.arange(len(rows.values)) if rows.frames is None else rows.frames - rows.frames[:1]
        rows.times, rows.origin = count * float(dt), None
        return
    if rows.times is None:
        touches = " Separate touches of a point need no times: use reframe-jax calibrate."
        hint = "" if is_path(rows.positions) else touches
        raise RecordingError(f"{rows.path}: has no times; {rows.no_times}.{hint}")
    _drop_unset(rows)
    factor = unit_of(rows.path, wanted, "time_unit", rows.seconds)
    rows.times = rows.times * factor
    if rows.origin is not None:
        if factor != 1:
            rows.origin = f"{Decimal(rows.origin) * Decimal(f'{factor:.0e}'):f}"
        rows.notes.append(f"times count from the first sample, at {rows.origin} s.")
    if rows.seconds is None and wanted.time_unit is None:
        _check_seconds(rows, rows.times)


def _drop_unset(rows: Rows) -> None:
    """Leave out rows whose time is 0 if all other times are distant from 0: their clock was not set."""
    times, origin = np.asarray(rows.times), float(rows.origin or 0)
    zero = times == -origin
    others = times[np.isfinite(times) & ~zero]
    nearest = np.abs(others + origin).min(initial=np.inf)
    if not zero.any() or not len(others) or nearest < max(EPOCH, _DISTANT * np.ptp(others)):
        return
    rows.keep(~zero, "their time is 0, so the clock was not set", "missing")
    if rows.origin is None:
        rows.times, rows.origin = times[~zero] - others[0], repr(float(others[0]))


def _check_seconds(rows: Rows, times: np.ndarray) -> None:
    """Refuse or note times that are probably not in seconds."""
    steps = np.diff(times[np.isfinite(times)])
    step = float(np.median(np.abs(steps))) if len(steps) else 0.0
    low, high = _SINCE_1970
    start = abs(float(rows.origin or 0))
    since = [
        unit
        for unit, factor in TIME_UNITS.items()
        if unit != "s" and low < start * factor < high and step * factor < _SLOWEST
    ]
    if step <= _SLOW and not since:
        return
    by_step = min(TIME_UNITS, key=lambda unit: abs(math.log(max(step, 1e-9) * TIME_UNITS[unit] / _USUAL)))
    unit = since[0] if since else by_step
    advice = f"give time_unit={unit!r} (--time-unit {unit})"
    if step > _SLOWEST or since:
        raise RecordingError(
            f"{rows.path}: read in s, the times are {step:.3g} s apart; they look like {unit}: {advice}, or "
            "the sample time, dt (--dt)."
        )
    if is_path(rows.positions):
        rows.notes.append(
            f"times are {step:g} s apart, although the body moves little between them; if they are in "
            f"{unit}, {advice}."
        )


def sort_times(rows: Rows) -> None:
    """Sort rows by their times, with a note.

    Raises:
        RecordingError: if the file contains several recordings, one after the other.
    """
    if rows.times is None:
        return
    steps = np.diff(rows.times)
    late = np.flatnonzero(steps < 0)
    if not len(late):
        return
    order = np.argsort(rows.times, kind="stable")
    if len(late) < len(steps) / 10 and _length(rows.values[order]) > _RESTART * _length(rows.values):
        now = int(late[0]) + 1
        raise rows.error(
            now,
            f"the time goes back from {rows.times[now - 1]:g} s to {rows.times[now]:g} s, and the poses "
            "sorted by time are no path: the file contains several recordings; divide it there, or give dt "
            "(--dt).",
        )
    what = f"{rows.word} {rows.where[late[0] + 1]} is" if len(late) == 1 else f"{len(late)} {rows.word}s are"
    rows.notes.append(f"{what} earlier than the previous {rows.word}; the rows are sorted by time.")
    rows.take(order)


def _length(values: np.ndarray) -> float:
    """Length of a path in all its numbers, in units of their standard deviations."""
    spread = values.std(axis=0)
    return float(np.sum(np.abs(np.diff(values, axis=0)) / np.where(spread > 0, spread, 1)))


def drop_equal_times(rows: Rows) -> None:
    """Keep the first row of every time, with a note.

    Raises:
        RecordingError: if most rows share their time with another row, or if rows with equal times belong to
            different bodies.
    """
    if rows.times is None or len(rows.times) < 2:
        return
    again = np.append(False, np.diff(rows.times) == 0)
    if not again.any():
        return
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))
    same = again & (rows.values == rows.values[first]).all(axis=1)
    other = again & ~same
    if other.any() and not np.ptp(rows.times):
        stamp = rows.origin or f"{rows.times[0]:g}"
        raise RecordingError(
            f"{rows.path}: all times are {stamp} (never set); give the sample time, dt (--dt)."
        )
    if other.sum() > _COARSE * len(again):
        raise RecordingError(
            f"{rows.path}: its {len(again)} rows have only {int(np.sum(~again))} different times; the times "
            "are rounded, or the file contains several bodies: select one, or give the sample time, dt "
            "(--dt)."
        )
    if other.sum() > _OFTEN * len(again):
        apart = np.median(np.linalg.norm((rows.values - rows.values[first])[other], axis=1))
        step = np.median(np.linalg.norm(np.diff(rows.values[~again], axis=0), axis=1))
        if apart > _BODIES * step:
            raise rows.error(
                int(np.flatnonzero(other)[0]),
                f"another pose at the same time, {rows.times[other][0]:g} s, as in {other.sum()} rows, "
                "distant from the first: the file contains several bodies; keep the rows of one.",
            )
    rows.keep(~same, "the previous row is repeated", "repeated")
    other = other[~same]
    if other.any():
        note = (
            f"{other.sum()} of {len(again)} rows left out, from {rows.word} {rows.where[other][0]} on: each "
            "has the time of the previous row and another pose."
        )
        rows.keep(~other, "another pose at the same time", "equal_time", note)
