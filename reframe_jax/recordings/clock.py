"""Times of the rows of a file: their unit, their order, and repeated times."""

import math
from decimal import Decimal

import numpy as np

from reframe_jax.geometry.numpy_rotations import angles_between
from reframe_jax.recordings.conventions import sample_rows
from reframe_jax.recordings.recording import EPOCH, RecordingError, Rows, is_path
from reframe_jax.recordings.selection import TIME_UNITS, Selection, unit_of

_SLOW, _SLOWEST = 0.9, 1e3  # s between samples: noted for a path; refused
_USUAL = 0.02, 1.0  # s between samples of a usual recording, and between separate touches
_SWIFT, _TURNING = 5.0, 8.0  # m/s and rad/s, above the usual speeds of a hand
_LAG = 50  # speeds are measured over one part of so many of a recording
_ROOM = 10.0  # m, span of positions of a hand or an arm
_SINCE_1970 = 3e8, 5e9  # s, clock times of recordings
_DISTANT = 10.0  # distance of the times from 0 over their span, above which a time of 0 was never set
_COARSE = 0.5  # fraction of rows with the time of another row, above which the times are rounded
_STEPS = 5.0  # usual steps, between poses of different bodies or recordings, and between parts in time
_OFTEN = 0.2  # fraction of rows with another pose at the same time: several bodies
_BEHIND = 10  # rows earlier than a previous row, above which the clock restarted and no row came late
_RESTART = 3.0  # length of the path sorted by time over its length in the file: several recordings


def make_times(rows: Rows, dt: float | None, wanted: Selection) -> None:
    """Set the times of the rows, s, to multiples of the sample time ``dt``, s, or to the times of the file.

    Missing times, and times in another unit than the given one, are refused.
    """
    if dt is not None:
        count = np.arange(len(rows.values)) if rows.frames is None else rows.frames - rows.frames[:1]
        rows.times, rows.origin, rows.seconds = count * float(dt), None, 1.0
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
            rows.origin = f"{Decimal(rows.origin) * Decimal(str(factor)):f}"
        rows.notes.append(f"times count from the first sample, at {rows.origin} s.")
    if rows.seconds is None and wanted.time_unit is None:
        _check_seconds(rows, rows.times)
    else:
        rows.seconds = factor


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
    """Refuse times that are certainly not in seconds."""
    steps = np.diff(times[np.isfinite(times)])
    step = float(np.median(np.abs(steps))) if len(steps) else 0.0
    low, high = _SINCE_1970
    start, path = abs(float(rows.origin or 0)), is_path(rows.positions)
    longest = _STEPS if path else _SLOWEST
    since = [
        unit
        for unit, factor in TIME_UNITS.items()
        if factor < 1 and low < start * factor < high and step * factor < longest
    ]
    if step > _SLOWEST or since:
        unit = since[0] if since else _likely_unit(step, path)
        raise RecordingError(
            f"{rows.path}: read in s, the times are {step:.3g} s apart; they look like {unit}: "
            f"give time_unit={unit!r} (--time-unit {unit}), or the sample time, dt (--dt)."
        )


def _likely_unit(step: float, path: bool) -> str:
    """Return the unit in which a time step is the most usual one."""
    return min(TIME_UNITS, key=lambda unit: abs(math.log(step * TIME_UNITS[unit] / _USUAL[0 if path else 1])))


def note_unit(rows: Rows, poses: np.ndarray, unordered: bool) -> None:
    """Add a note to ``rows`` if poses (N, 4, 4), m, change so slowly or so fast that the unit is in doubt."""
    if rows.seconds is not None or rows.times is None or len(poses) < 2 or unordered:
        return
    step = float(np.median(np.diff(rows.times)))
    if step > _SLOW:
        unit = _likely_unit(step, True)
        frames = (np.diff(rows.times) == 1).all()
        rows.notes.append(
            f"times are {step:g} s apart, although the body moves little between them; if they are "
            + ("frame numbers, give the sample time, dt (--dt); if they are " if frames else "")
            + f"in {unit}, give time_unit={unit!r} (--time-unit {unit})."
        )
        return
    lag = -(-len(poses) // _LAG)
    some = sample_rows(len(poses) - lag)
    spans, before, after = rows.times[some + lag] - rows.times[some], poses[some], poses[some + lag]
    moved = np.median(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) / spans)
    turned = np.median(angles_between(before[:, :3, :3], after[:, :3, :3]) / spans)
    vehicle = np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)) > _ROOM
    if (moved > _SWIFT and not vehicle) or (turned > _TURNING and rows.angles is None):
        rows.notes.append(
            f"read in s, the body moves at {moved:.2g} m/s and turns at {turned:.2g} rad/s; if the times are "
            "in minutes or hours, give time_unit='min' or 'h' (--time-unit)."
        )


def sort_times(rows: Rows) -> None:
    """Sort rows by their times, or continue a clock that wraps or restarts during the motion, with a note.

    Several recordings in one file, one after the other, are refused.
    """
    if rows.times is None:
        return
    steps = np.diff(rows.times)
    late = np.flatnonzero(steps < 0)
    if not len(late):
        return
    order = np.argsort(rows.times, kind="stable")
    now = int(late[0]) + 1
    if len(late) < len(steps) / 10:
        moved, after = _distances(rows.values), _distances(rows.values[order])
        behind = np.sum(rows.times < np.maximum.accumulate(rows.times))
        step = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
        # parts in another order, whose times have no gaps and do not overlap
        swapped = np.diff(rows.times[order]).max() < _STEPS * step
        swapped &= np.sum(np.diff(order) != 1) <= len(late)
        back = f"the time goes back from {rows.times[now - 1]:g} s to {rows.times[now]:g} s, and the "
        goes_on = (moved[late] < _STEPS * np.quantile(moved, 0.9)).all() and not swapped
        if behind > _BEHIND * len(late) and goes_on:
            onward = np.where(steps < 0, step, steps)
            rows.times = rows.times[0] + np.append(0, np.cumsum(onward))
            rows.notes.append(
                f"{rows.word} {rows.where[now]}: {back}motion goes on: the clock restarted there. The times "
                "continue with the usual step."
            )
            return
        if np.sum(after) > _RESTART * np.sum(moved):
            raise rows.error(
                now,
                f"{back}poses sorted by time are no path: the file contains several recordings; divide it "
                "there, or give dt (--dt).",
            )
    what = f"{rows.word} {rows.where[now]} is" if len(late) == 1 else f"{len(late)} {rows.word}s are"
    rows.notes.append(f"{what} earlier than the previous {rows.word}; the rows are sorted by time.")
    rows.take(order)


def _distances(values: np.ndarray) -> np.ndarray:
    """Distances (N-1,) of consecutive rows in all their numbers, in units of their standard deviations."""
    spread = values.std(axis=0)
    return np.sum(np.abs(np.diff(values, axis=0)) / np.where(spread > 0, spread, 1), axis=1)


def drop_equal_times(rows: Rows) -> None:
    """Keep the first row of every time, with a note.

    Files are refused in which most rows share their time with another row, or rows belong to several bodies.
    """
    times = np.asarray(rows.times)
    again = np.diff(times, prepend=np.nan) == 0
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))
    same = again & (rows.values == rows.values[first]).all(axis=1)
    other = again & ~same
    if other.any() and not np.ptp(times):
        stamp = rows.origin or f"{times[0]:g}"
        raise RecordingError(f"{rows.path}: all times are {stamp} (unset); give the sample time, dt (--dt).")
    if other.sum() > _COARSE * len(again):
        raise RecordingError(
            f"{rows.path}: its {len(again)} rows have only {int(np.sum(~again))} different times; the times "
            "are rounded, or the file contains several bodies: select one, or give the sample time, dt "
            "(--dt)."
        )
    if other.sum() > _OFTEN * len(again):
        apart = np.median(np.linalg.norm((rows.values - rows.values[first])[other], axis=1))
        step = np.median(np.linalg.norm(np.diff(rows.values[~again], axis=0), axis=1))
        if apart > _STEPS * step:
            raise rows.error(
                int(np.flatnonzero(other)[0]),
                f"another pose at the same time, {times[other][0]:g} s, as in {other.sum()} rows, "
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
