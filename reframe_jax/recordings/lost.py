"""Find the rows of a recording that are not poses, because tracking was lost.

Systems that lose a body still write a pose: the origin, the identity, another constant, or the last pose
again and again, some with a little noise. Measured poses have noise and do not repeat exactly, and a body at
rest stays on its path. Therefore, repeats are lost poses if they are distant from the path before and after
them, in units of the steps of the path. Repeats that continue the path are a body at rest, and are kept.
"""

import numpy as np

from reframe_jax.recordings.recording import is_path

_SAME = 1e-9  # m, or difference of elements of rotation matrices, within which numbers are equal
_LEAST = 1e-3  # m or rad, shortest step that counts, because quantized numbers repeat too
_JUMP_STEPS = 5.0  # length of a jump in usual steps of the path
_ORIGIN_JUMP_STEPS = 3.0  # as _JUMP_STEPS, for exact zeros, which no tracker measures
_NEAR = 20  # steps in the neighbourhood of a run
_AHEAD = 4  # steps before and after a frozen run
_LONG = 6  # repeats with noise in a frozen run
_SUDDEN = 3.0  # length of a jump over that of all steps nearby, and of steps between repeats with noise
_BENDS = 3.0  # length of a jump beyond the steps nearby, over the largest usual change of the steps
_APART = 0.25  # distance of the origin from all positions over their spread, for separate touches
_OTHERS = 3  # other rows needed to know the path
_SPREAD = 2.0  # largest distance from the mean of repeats with noise, over that of the last six
_STILL = 0.05  # largest distance of repeats with noise from their mean, or from the origin, over the jump
_SLOW = 0.15  # the same of a constant, over its number of rows and a usual step; 0.3 in a motion
_BETWEEN = 0.8  # distance of the poses before and after repeats over their distances from the repeats
_AWAY = 0.5  # distance from the path that goes on, over the jump
_GAP = 1.5  # time between two rows, in usual time steps, above which rows are missing
_BLOCK = 2**14  # rows per block, so that intermediate arrays stay small
_FEW = 2000  # largest number of positions for which all distances are computed
_REPEATS, _NOISY = 3, 0.002  # repeats, and noise over a step, of a frozen end
_HELD = 3  # other runs of at least half the length, which show that samples are written too often
_PAST = 200  # rows from which noise and speed are estimated


def find_lost_poses(poses: np.ndarray, times: np.ndarray | None = None) -> np.ndarray:
    """Find the rows of poses (K, 4, 4), m, that are not poses; by default, times (K,), s, are evenly spaced.

    The result (K,) is the reason for every row, empty for poses: "missing" (not finite), "origin" (position
    0, 0, 0), "identity" (the orientation is the identity), "constant" (another number that repeats), "frozen"
    (repeats the previous pose), or "end" (repeats the previous pose to the end of the recording).
    """
    poses = np.asarray(poses, float)
    clock = np.arange(len(poses), dtype=float) if times is None else np.asarray(times, float)
    kinds = np.where(np.isfinite(poses).all(axis=(1, 2)), "", "missing").astype("U8")
    rows, paths = np.flatnonzero(kinds == ""), None
    for search in (_at_origin, _constant, _noisy, _frozen):
        if len(rows) < _OTHERS:
            break
        if paths is None:
            spans = np.diff(clock[rows])
            late = spans / (_quantile(spans[spans > 0], 0.5) or 1.0)
            turns = poses[rows, :3, :3].reshape(-1, 9) / np.sqrt(2)
            identity = np.eye(3).ravel() / np.sqrt(2)
            paths = _Path(poses[rows, :3, 3], np.zeros(3), late), _Path(turns, identity, late)
        found = np.full(len(rows), "", kinds.dtype)
        search(paths, found)
        kinds[rows] = found
        if (found != "").any():  # the remaining rows have other paths
            rows, paths = rows[found == ""], None
    return kinds


def _quantile(numbers: np.ndarray, fraction: float) -> float:
    """Quantile of numbers (N,), 0 if there are none."""
    return float(np.quantile(numbers, fraction)) if len(numbers) else 0.0


class _Path:
    """Positions or rotations (N, k) as a path; rows took ``late`` (N-1,) median time steps."""

    def __init__(self, numbers: np.ndarray, origin: np.ndarray, late: np.ndarray) -> None:
        count, weights = len(numbers), np.pi * np.sqrt(2 + np.arange(len(origin)))
        self.numbers, self.origin = numbers, origin
        self.gaps = late > _GAP  # (N-1,) bool: rows are missing between the two
        self.keys = np.empty(count)  # equal for equal rows
        self.zero = np.empty(count, bool)  # the numbers are those of the origin
        squares = np.empty(count - 1)
        for start in range(0, count, _BLOCK):
            part, here = slice(start, start + _BLOCK), numbers[start : start + _BLOCK + 1]
            squares[part] = np.square(np.diff(here, axis=0)).sum(axis=1)
            here = here[:_BLOCK]
            self.keys[part] = (np.round(here / _SAME) * weights).sum(axis=1)
            self.zero[part] = (np.abs(here - origin) < _SAME).all(axis=1)
        steps = np.sqrt(squares)
        steps[steps < _SAME] = 0
        self.steps = steps / np.maximum(late, 1)  # (N-1,) per median time step, if the step took longer
        self.lengths = self.steps[self.steps > 0]

    @property
    def runs(self) -> np.ndarray:
        """(M, 2) first row, and row after the last row, of runs of equal rows."""
        edges = np.flatnonzero(np.diff(self.keys)) + 1
        return np.column_stack([np.append(0, edges), np.append(edges, len(self.keys))])

    def jumps(self, runs: np.ndarray, limit: float, ignored: np.ndarray) -> np.ndarray:
        """Return whether the shorter and the longer step to and from runs (M, 2) are jumps, bool (M, 2).

        A run at an end of the path has one step, which counts for both. Lengths are in usual steps, or in the
        upper quartile of the steps nearby if it is longer. Steps from and to ignored rows (N,) do not count,
        unless there are no others.
        """
        count = -(-len(self.steps) // _NEAR)
        blocks = np.full(count * _NEAR, np.inf)
        unknown = ignored[1:] | ignored[:-1] | (self.steps == 0)
        blocks[: len(self.steps)] = np.where(unknown, np.inf, self.steps)
        blocks = np.sort(blocks.reshape(count, _NEAR), axis=1)
        known = np.isfinite(blocks).sum(axis=1)
        long = np.where(known > 0, blocks[np.arange(count), 3 * np.maximum(known - 1, 0) // 4], 0.0)
        near = long[np.clip(np.column_stack([runs[:, 0] - 1, runs[:, 1]]) // _NEAR, 0, count - 1)]
        usual = _quantile(self.steps[~unknown], 0.9) or _quantile(self.lengths, 0.9)
        step = np.maximum(near.max(axis=1), max(usual, _LEAST))
        ends = np.concatenate([[np.nan], self.steps, [np.nan]])[runs]
        both = np.column_stack([np.fmin(*ends.T), np.fmax(*ends.T)])
        return both > limit * step[:, None]


def _at_origin(paths: tuple[_Path, _Path], kinds: np.ndarray) -> None:
    """Mark the rows (N,) with position 0, 0, 0 or orientation identity that are distant from the path."""
    position, turn = paths
    for path in paths:
        if np.sum(~path.zero) < _OTHERS or not path.zero.any():
            continue
        runs = path.runs
        lengths = np.diff(runs, axis=1)[:, 0]
        away = path.zero[runs[:, 0]]
        if path is not position or is_path(path.numbers) or not _is_apart(path):
            # at one end of a run, the path may be close to the origin by chance
            jumps = path.jumps(runs, _ORIGIN_JUMP_STEPS, path.zero)
            away &= np.where(lengths > 1, jumps[:, 1], jumps[:, 0])
        lost = np.repeat(away, lengths)
        kinds[lost] = "origin" if path is position else "identity"
        kinds[lost & position.zero & turn.zero] = "identity"


def _is_apart(path: _Path) -> bool:
    """Return whether the origin is distant from all positions; False for many positions."""
    others = path.numbers[~path.zero]
    if not _OTHERS <= len(others) <= _FEW:
        return False
    spread = np.sqrt(np.mean(np.sum((others - others.mean(axis=0)) ** 2, axis=1)))
    between = np.linalg.norm(others[:, None] - others, axis=2) + np.diag(np.full(len(others), np.inf))
    nearest = np.linalg.norm(others, axis=1).min()
    usual = np.quantile(between.min(axis=1), 0.9)
    return bool(nearest > max(_APART * spread, _ORIGIN_JUMP_STEPS * usual, _SAME))


def _constant(paths: tuple[_Path, _Path], kinds: np.ndarray) -> None:
    """Mark the rows (N,) with another number that occurs repeatedly, and always distant from the path."""
    for path in paths:
        if np.diff(np.sort(path.keys)).all():
            continue
        value, counts = np.unique(path.keys, return_inverse=True, return_counts=True)[1:]
        repeated = (counts > 1)[value]
        runs, last = path.runs, len(kinds) - 1
        # repeats between the pose before and the pose after them are on the path
        before, here, after = (path.numbers[np.clip(rows, 0, last)] for rows in (runs[:, 0] - 1, *runs.T))
        around = np.linalg.norm(here - before, axis=1) + np.linalg.norm(after - here, axis=1)
        between = np.linalg.norm(after - before, axis=1) > _BETWEEN * around
        between &= (runs[:, 0] > 0) & (runs[:, 1] <= last)
        stays = (counts == 1) | (len(kinds) - counts < _OTHERS)
        # a number that continues the path anywhere is a pose
        away = path.jumps(runs, _JUMP_STEPS, repeated)[:, 0] & ~between
        stays[value[runs[~away, 0]]] = True
        kinds[~stays[value]] = "constant"


def _noisy(paths: tuple[_Path, _Path], kinds: np.ndarray) -> None:
    """Mark the rows (N,) that repeat a number with noise, between a jump from the path and a jump back."""
    for path in paths:
        usual = max(_quantile(path.lengths, 0.9), _LEAST)
        edges = np.flatnonzero(path.steps > _JUMP_STEPS * usual) + 1
        if not len(edges):
            continue
        starts, stops = np.append(0, edges), np.append(edges, len(kinds))
        leaps = np.linalg.norm(path.numbers[edges] - path.numbers[edges - 1], axis=1)
        spread = 2 * np.median(np.linalg.norm(path.numbers - np.median(path.numbers, axis=0), axis=1))
        leaps = np.where(spread > 0, np.minimum(leaps, spread), leaps)  # an outlier may be at any distance
        near = _STILL * np.fmin(np.append(np.nan, leaps), np.append(leaps, np.nan))
        lengths = stops - starts
        if lengths.max() < _REPEATS:
            continue
        means = np.add.reduceat(path.numbers, starts) / lengths[:, None]
        zero = _reaches(path.numbers, path.origin, starts) < near
        spans = _reaches(path.numbers, np.repeat(means, lengths, axis=0), starts)
        still = spans < np.minimum(near, _SLOW * usual * lengths)
        several = still & (lengths >= _REPEATS)
        if not several.any() or still.all():
            continue
        # the last row of the path before each piece, and the first row of the path after it
        pieces = np.arange(len(starts))
        before = np.maximum.accumulate(np.where(still, -1, pieces))
        after = np.minimum.accumulate(np.where(still, len(pieces), pieces)[::-1])[::-1]
        last, first = stops[before] - 1, starts[after % len(pieces)]
        away = np.stack([np.linalg.norm(means - path.numbers[row], axis=1) for row in (last, first)])
        distant = away > _JUMP_STEPS * usual * np.stack([starts - last, first - stops + 1])
        gap = np.linalg.norm(path.numbers[first] - path.numbers[last], axis=1)
        inside = distant.all(axis=0) & (gap < _AWAY * away.min(axis=0))
        # at an end of the path, only the origin is known not to be a pose
        known = np.stack([before >= 0, after < len(pieces)])
        inside &= several & known.all(axis=0)
        zero &= several & np.where(known.all(axis=0), distant.all(axis=0), (distant & known).any(axis=0))
        turn = paths[1]
        identity = _reaches(turn.numbers, turn.origin, starts) < _STILL if path is not turn else zero
        lost = np.where(zero, np.where(identity, "identity", "origin"), np.where(inside, "constant", ""))
        for kind in sorted({*lost.tolist()} - {""}):  # the same number elsewhere is lost too
            longest = np.argmax(np.where(lost == kind, lengths, 0))
            same = np.linalg.norm(means - means[longest], axis=1) < near
            lost[several & same & (lost == "")] = kind
        kinds[:] = np.where(kinds == "", np.repeat(lost, lengths), kinds)


def _reaches(numbers: np.ndarray, centres: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Largest distances of the rows of pieces, which begin at ``starts``, from centres (k,) or (N, k)."""
    return np.maximum.reduceat(np.linalg.norm(numbers - centres, axis=1), starts)


def _frozen(paths: tuple[_Path, _Path], kinds: np.ndarray) -> None:
    """Mark the rows (N,) that repeat a position or an orientation while the body moved on.

    The first row of every run is a pose.
    """
    for path in paths:
        if 0 < len(path.lengths) < len(path.steps):
            _mark_repeats(path, kinds)
        _mark_rests(path.numbers[::-1], path.steps[::-1], path.gaps[::-1], kinds[::-1], at_end=True)
        _mark_rests(path.numbers, path.steps, path.gaps, kinds)


def _mark_repeats(path: _Path, kinds: np.ndarray) -> None:
    """Mark rows in ``kinds`` (N,) that repeat exactly, while the body moved on or at the end of its path."""
    moving, count = np.flatnonzero(path.steps), len(kinds)
    starts, stops = np.append(0, moving + 1), np.append(moving + 1, count)
    lengths = stops - starts
    late = np.flatnonzero(lengths[:-1] > 1)
    frozen = np.zeros(len(lengths), bool)
    # the step after frozen rows is as long as the missed steps together; after few rows, it must be longer
    steps, repeats, bends = path.steps[moving], lengths[late] - 1, _bends(path.numbers[starts])
    usual = np.fmax(_largest_near(steps, late, _AHEAD), _quantile(steps, 0.5))
    bend = np.fmax(_largest_near(bends, late, _AHEAD - 1), _usual_bend(steps, bends))
    bend[repeats < _REPEATS] = np.inf
    missed = np.minimum(0.5 * repeats, _SUDDEN) * usual
    frozen[late] = steps[late] > usual + np.minimum(missed, _BENDS * bend) + _LEAST
    kinds[1:][np.repeat(frozen, lengths)[1:] & (path.steps == 0)] = "frozen"
    # a run before missing rows, or before the end, has no step after it that shows a motion
    last = np.append(path.gaps[moving], True)
    ranked = np.sort(lengths[lengths > 1])
    held = len(ranked) - np.searchsorted(ranked, lengths / 2) > _HELD
    for run in np.flatnonzero(last & (lengths > _REPEATS) & ~held):
        if _stops_dead(path, starts[run]):
            kinds[starts[run] + 1 : stops[run]] = "end" if stops[run] == count else "frozen"


def _largest_near(numbers: np.ndarray, rows: np.ndarray, size: int) -> np.ndarray:
    """Largest of ``size`` numbers from four before each row on, and of as many from one after the row on."""
    unknown = np.full(_AHEAD + 1, np.nan)
    padded = np.concatenate([unknown, numbers, unknown])
    largest = np.fmax.reduce(np.lib.stride_tricks.sliding_window_view(padded, size), axis=1)
    return np.fmax(largest[rows + 1], largest[rows + _AHEAD + 2])


def _bends(numbers: np.ndarray) -> np.ndarray:
    """Changes (N-2,) of the steps of a path (N, k); by column, with little memory."""
    return np.sqrt(sum(np.diff(column, 2) ** 2 for column in numbers.T))


def _usual_bend(steps: np.ndarray, bends: np.ndarray) -> float:
    """Ninth decile of the changes (N-2,) of the steps (N-1,), where the body moves."""
    return _quantile(bends[np.minimum(steps[1:], steps[:-1]) >= _quantile(steps, 0.5)], 0.9)


def _mark_rests(
    numbers: np.ndarray, steps: np.ndarray, gaps: np.ndarray, kinds: np.ndarray, at_end: bool = False
) -> None:
    """Mark rows in ``kinds`` (N,) that repeat a number with noise up to a jump.

    A body at rest starts slowly, or with a step of the path: its first step is no jump. A frozen body moves
    before the repeats and after the jump, and the jump is no longer than the missed path. Repeats from row 0
    on are a constant; ``at_end`` searches for nothing else. The arguments are those of :class:`_Path`.
    """
    count = len(numbers)
    if count <= _LONG + _AHEAD:
        return
    jumping = (steps[_LONG - 1 : -_AHEAD] > _LEAST) & ~gaps[_LONG - 1 : -_AHEAD]
    for lag in range(1, _LONG):
        jumping &= steps[_LONG - 1 : -_AHEAD] > _SUDDEN * steps[_LONG - 1 - lag : -_AHEAD - lag]
    stops = np.flatnonzero(jumping) + _LONG
    if not len(stops):
        return
    held = numbers[stops[:, None] + np.arange(-_LONG, 0)]
    centres = held.mean(axis=1)
    reaches = _SPREAD * np.linalg.norm(held - centres[:, None], axis=2).max(axis=1)
    jumps = np.linalg.norm(numbers[stops] - centres, axis=1)
    afters = np.sort(steps[stops[:, None] + np.arange(_AHEAD)], axis=1)
    between = np.sort(steps[stops[:, None] + np.arange(-_LONG, -1)], axis=1)
    known = jumps > np.maximum(afters[:, -1], reaches) + _LEAST
    known &= np.linalg.norm(numbers[stops + _AHEAD] - numbers[stops], axis=1) >= reaches
    # noise instead of a steady motion, and no exact repeats or another jump
    known &= np.linalg.norm(held[:, -1] - held[:, 0], axis=1) < 0.7 * between.sum(axis=1)
    known &= (between[:, 0] > 0) & (between[:, -1] <= _SUDDEN * between[:, -2])
    bends: np.ndarray | None = None
    for i in np.flatnonzero(known):
        stop, jump, after = stops[i], jumps[i], afters[i]
        first = _first_near(numbers[:stop], centres[i], reaches[i])
        if first == 0 and 2 * stop < count and jump > _SUDDEN * after[-1]:
            near = _quantile(np.linalg.norm(numbers[stop:] - centres[i], axis=1), 0.25)
            if near > _SPREAD * np.linalg.norm(numbers[stop:].std(axis=0)):
                kinds[:stop] = "constant"
        if at_end or first < _AHEAD or np.linalg.norm(numbers[first] - numbers[first - _AHEAD]) < reaches[i]:
            continue
        # in several steps before the repeats and after the jump, without another jump
        ahead = np.sort(steps[first - _AHEAD : first])
        moves = all(near[-1] <= _SUDDEN * near[-2] for near in (ahead, after))
        usual = max(ahead[-1], after[-1])
        if moves and usual < jump < (stop - first) * (ahead[-1] + after[-1]):
            bends = _bends(numbers) if bends is None else bends
            local = max(bends[first - _AHEAD : first - 1].max(), bends[stop : stop + _AHEAD - 1].max())
            if jump > usual + min(2 * usual, _BENDS * max(local, _usual_bend(steps, bends))):
                kinds[first + 1 : stop] = "frozen"


def _first_near(numbers: np.ndarray, centre: np.ndarray, reach: float) -> int:
    """First of the rows at the end of numbers (N, k) that are all within ``reach`` of ``centre``."""
    size = 2 * _LONG
    while True:
        size, start = 2 * size, max(len(numbers) - size, 0)
        away = np.flatnonzero(np.linalg.norm(numbers[start:] - centre, axis=1) > reach)
        if len(away) or not start:
            return start + int(away[-1]) + 1 if len(away) else 0


def _stops_dead(path: _Path, start: int) -> bool:
    """Return whether the body moves, with noise, up to a row from which the pose repeats exactly."""
    if (path.steps[max(start - _AHEAD, 0) : start] == 0).any():  # it comes to rest, in rounded numbers
        return False
    rows = path.numbers[max(start - _PAST, 0) : start + 1]
    rows = rows[np.append(True, (np.diff(rows, axis=0) != 0).any(axis=1))]
    if len(rows) < _NEAR:
        return False
    fifth = np.linalg.norm(np.diff(rows, n=5, axis=0), axis=1)  # almost zero for smooth motion
    noise = np.median(fifth) / np.sqrt(252)
    speeds = np.linalg.norm(rows[_AHEAD:] - rows[:-_AHEAD], axis=1) / _AHEAD
    usual = float(np.median(speeds[-_NEAR // 2 :]))
    fast = speeds[-1] > max(0.5 * usual, 5 * np.sqrt(2) / _AHEAD * noise)
    slower = np.linalg.norm(rows[-1] - rows[-2]) < 0.5 * usual - 3 * noise  # as of a body that comes to rest
    return bool(fast and not slower and noise > _NOISY * usual)
