"""Cleaning of tracker recordings by leaving poses out.

NumPy only. A pose is kept as measured or left out, never moved: smoothing across a lost frame invents motion,
whereas the chord between two measured poses is exact, however far apart they are.

Three things spoil a recording from a camera. Single poses jump away and back. Noise of standard deviation s,
divided by a short sample time, looks like a velocity of ``sqrt(2) s / dt``. Rest before and after the motion
lowers the means over time. Therefore :func:`clean_recording` leaves out outliers, thins the others to steps
long enough for the noise, and cuts off rest at both ends.
"""

from dataclasses import replace

import numpy as np

from reframe_jax.geometry.numpy_rotations import rotation_vectors
from reframe_jax.identification.classify import Thresholds
from reframe_jax.motion.checks import MIN_VELOCITIES
from reframe_jax.recordings.recording import Recording

__all__ = ["clean_recording", "pose_noise", "pose_outliers", "recording_warnings"]

_HALF = 3  # neighbours on each side: a majority of them outvotes outliers of up to two poses
_OUTLIER = 6.0  # distance from the line through the neighbours, in units of their scatter
_QUIET = 5.0  # thresholds over velocity that is noise, in cleaned recordings
_LOUD = 3.0  # the same, below which a recording gets a warning
_MIN_STEPS = 50  # left by a step that is chosen here: the length of the paper's windows
_FEW, _MUCH = 0.02, 0.5  # steps that make up this share of a mean square are worth a warning
_GAUSSIAN = 1.4826  # standard deviation over median absolute deviation
_GROWTH = 8.0  # of the variance of third differences at twice the distance, for motion well sampled
_LISTED = 6  # samples listed in a sentence


def clean_recording(
    recording: Recording,
    *,
    step: float | None = None,
    thresholds: Thresholds = Thresholds(),  # noqa: B008
) -> Recording:
    """Leave out outliers, and the poses between which noise outweighs motion.

    Keeps the first pose that is not an outlier, then always the next one at least ``step`` later. At both
    ends, leaves out poses that are no further from the first or last pose, in position and orientation, than
    the threshold velocities lead in one step.

    The default step is the shortest at which the velocity of the noise (see :func:`pose_noise`) is at most a
    fifth of either threshold, limited so that 50 steps fit in the recording. If the sample time is long
    enough, only outliers are left out.

    Args:
        recording: of N poses.
        step: s; chosen from the noise by default; 0 leaves out only outliers.
        thresholds: those of the identification, plain numbers.

    Returns:
        The remaining poses, with notes on those left out.

    Raises:
        ValueError: if the step is negative or not finite.
    """
    if step is not None and not 0 <= step < np.inf:
        raise ValueError(f"step must be a number of seconds, 0 or more, not {step!r}.")
    times, poses, limits = recording.times, recording.poses, _limits(thresholds)
    notes, out = [], pose_outliers(times, poses)
    if out.any():
        notes.append(f"left out, for jumping away and back: {_samples(np.flatnonzero(out))}.")
    kept = np.flatnonzero(~out)
    own = float(np.median(np.diff(times[kept])))
    noise = pose_noise(poses[kept])
    why = "as told"
    if step is None:
        wanted = float(np.max(_QUIET * np.sqrt(2) * noise / limits))
        longest = (times[kept[-1]] - times[kept[0]]) / _MIN_STEPS
        step = min(wanted, longest)
        why = f"for a noise of {_noise_text(noise)}"
    if step > own:
        moving = _moving(poses[kept], limits * step)
        thinned = moving[_thinned(times[kept[moving]], step)]
        if len(thinned) <= MIN_VELOCITIES:
            notes.append(f"steps of {step:.2g} s would leave too few poses: all are kept.")
        else:
            rest = len(kept) - len(moving)
            cut = f", after {rest} at rest at the ends were left out" if rest else ""
            notes.append(f"thinned to {len(thinned)} poses, at least {step:.2g} s apart, {why}{cut}.")
            kept = kept[thinned]
    return replace(
        recording,
        times=times[kept],
        poses=poses[kept],
        notes=(*recording.notes, *notes),
        wrenches=None if recording.wrenches is None else recording.wrenches[kept],
    )


def pose_outliers(times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Find poses that jump away from their neighbours and back.

    A robust line (medians of slopes and of intercepts) is drawn through the six neighbours of every pose, in
    the tangent space there, for orientation and position each. An outlier lies further from the line than
    six times their scatter about it, or the median scatter in the recording if that is larger; and the poses
    before and after it lie on the same side of it. Fast motion is not an outlier, nor is a body that is
    elsewhere after lost frames. The first and last pose never are.

    Args:
        times: (N,) s, increasing.
        poses: (N, 4, 4), m.

    Returns:
        (N,) bool.
    """
    count, width = len(times), 2 * _HALF
    if count <= width:
        return np.zeros(count, bool)
    first = np.clip(np.arange(count) - _HALF, 0, count - width - 1)
    near = first[:, None] + np.arange(width + 1)
    near = near[near != np.arange(count)[:, None]].reshape(count, width)
    after = near > np.arange(count)[:, None]
    later = times[near] - times[:, None]
    turns = _unwrapped(rotation_vectors(poses[:, None, :3, :3].swapaxes(-1, -2) @ poses[near, :3, :3]))
    outliers = np.zeros(count, bool)
    for offsets in (turns, poses[near, :3, 3] - poses[:, None, :3, 3]):
        a, b = np.triu_indices(width, 1)
        slope = np.median((offsets[:, b] - offsets[:, a]) / (later[:, b] - later[:, a])[..., None], axis=1)
        level = offsets - slope[:, None] * later[..., None]
        line = np.median(level, axis=1)
        scatter = np.median(np.linalg.norm(level - line[:, None], axis=-1), axis=1)
        far = np.linalg.norm(line, axis=-1) > _OUTLIER * np.maximum(scatter, np.median(scatter)) + 1e-9
        sides = [
            np.nanmedian(np.where(side[..., None], offsets, np.nan)[1:-1], axis=1) for side in (after, ~after)
        ]
        outliers[1:-1] |= far[1:-1] & (np.sum(sides[0] * sides[1], axis=-1) > 0)
    return outliers


def pose_noise(poses: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation of white noise in orientation and position.

    Uses the medians of third differences, so a few jumps do not matter. Differences over twice the lag reveal
    the share of motion, which is subtracted: their variance grows with motion, by up to 64 if it is smooth (8
    is assumed), whereas that of noise does not. Errors that change slowly, such as those that depend on the
    view, are not included.

    Args:
        poses: (N, 4, 4), m, evenly sampled.

    Returns:
        (2,), rad and m: root of the summed variances of the three axes. Zero for fewer than 8 poses.
    """
    if len(poses) < 8:
        return np.zeros(2)
    variances = []
    for lag in (1, 2):
        here, there = poses[:-lag], poses[lag:]
        turns = rotation_vectors(there[:, :3, :3] @ here[:, :3, :3].swapaxes(-1, -2))
        steps = np.stack([turns, there[:, :3, 3] - here[:, :3, 3]])
        third = steps[:, 2 * lag :] - 2 * steps[:, lag:-lag] + steps[:, : -2 * lag]
        deviation = _GAUSSIAN * np.median(np.abs(third), axis=1)
        variances.append(np.sum(deviation**2, axis=-1) / 20)  # 1 + 9 + 9 + 1
    single, double = variances
    noise: np.ndarray = np.sqrt(np.maximum(_GROWTH * single - double, 0) / (_GROWTH - 1))
    return noise


def recording_warnings(
    recording: Recording,
    thresholds: Thresholds = Thresholds(),  # noqa: B008
) -> list[str]:
    """Describe what could mislead the identification of a recording, in sentences.

    Reports noise whose velocity exceeds a third of a threshold, outliers, and few steps that make up most of
    a mean square.

    Args:
        recording: the recording as loaded.
        thresholds: those of the identification, plain numbers.
    """
    times, poses = recording.times, recording.poses
    steps, limits, said = np.diff(times), _limits(thresholds), []
    out = np.flatnonzero(pose_outliers(times, poses))
    turns = rotation_vectors(poses[1:, :3, :3] @ poses[:-1, :3, :3].swapaxes(-1, -2))
    for name, moved in (("angular", turns), ("linear", np.diff(poses[:, :3, 3], axis=0))):
        squares = np.sum(moved**2, axis=-1) / steps**2
        order = np.argsort(squares)[::-1]
        share = np.cumsum(squares[order]) / max(float(squares.sum()), np.finfo(float).tiny)
        few = int(np.searchsorted(share, _MUCH)) + 1
        if few <= _FEW * len(steps):
            said.append(
                f"{few} of {len(steps)} steps make up {share[few - 1]:.0%} of the mean square {name} "
                f"velocity: to {_samples(np.sort(order[:few]) + 1)}."
            )
    if len(out):
        said.append(f"poses jump away and back: {_samples(out)}.")
    noise, own = pose_noise(np.delete(poses, out, axis=0)), float(np.median(steps))
    speeds = np.sqrt(2) * noise / own
    if (_LOUD * speeds > limits).any():
        said.append(
            f"noise of {_noise_text(noise)} looks like {speeds[0]:.2g} rad/s and {speeds[1]:.2g} m/s, with "
            f"{own:.2g} s between poses; the thresholds are {limits[0]:g} and {limits[1]:g}."
        )
    return said


def _unwrapped(turns: np.ndarray) -> np.ndarray:
    """Rotation vectors (N, M, 3), of the two for each rotation those on the side of the largest in its row.

    Neighbours of a pose that is off by about a half turn are close to each other, their logarithms are not.
    """
    angles = np.linalg.norm(turns, axis=-1, keepdims=True)
    largest = np.take_along_axis(turns, np.argmax(angles, axis=1)[..., None], axis=1)
    others = turns * (1 - 2 * np.pi / np.where(angles == 0, 1, angles))
    nearer = np.linalg.norm(others - largest, axis=-1) < np.linalg.norm(turns - largest, axis=-1)
    return np.where(nearer[..., None], others, turns)


def _moving(poses: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Indices of the poses between the rest at either end, of which one pose is kept."""
    away = []
    for end in (poses[0], poses[-1]):
        turns = np.linalg.norm(rotation_vectors(end[:3, :3].T @ poses[:, :3, :3]), axis=-1)
        distances = np.linalg.norm(poses[:, :3, 3] - end[:3, 3], axis=-1)
        away.append(np.flatnonzero((turns > reach[0]) | (distances > reach[1])))
    if not len(away[0]) or not len(away[1]):
        return np.arange(len(poses))
    return np.arange(away[0][0] - 1, away[1][-1] + 2)


def _thinned(times: np.ndarray, step: float) -> np.ndarray:
    """Indices of samples that are a step apart."""
    kept = [0]
    for index in range(1, len(times)):
        if times[index] - times[kept[-1]] >= (1 - 1e-6) * step:
            kept.append(index)
    return np.asarray(kept)


def _limits(thresholds: Thresholds) -> np.ndarray:
    return np.asarray([thresholds.angular, thresholds.linear], float)


def _noise_text(noise: np.ndarray) -> str:
    return f"{np.degrees(noise[0]):.2g} deg and {1e3 * noise[1]:.2g} mm"


def _samples(indices: np.ndarray) -> str:
    """The first of some samples, and how many more there are."""
    listed = ", ".join(map(str, indices[:_LISTED]))
    more = f" and {len(indices) - _LISTED} more" if len(indices) > _LISTED else ""
    return f"sample{'s' if len(indices) > 1 else ''} {listed}{more}"
