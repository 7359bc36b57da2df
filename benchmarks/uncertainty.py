"""How well the library knows what it does not know: intervals, probabilities, and ambiguous motions.

- Coverage: the share of 95 % intervals of the covariance that hold the truth, over all directions in which
  the axes and the origin are determined, for every constraint and noise level. With white noise it should be
  92 to 98 %; where it falls short, the noise is too large for a first-order covariance, or the noise of the
  window is hard to tell. Also printed is the root of the mean square of error over standard deviation,
  without the worst one per cent, and the share of windows with the right class, which alone are counted.
- Reliability: of the probabilities of the name and of free axes: the mean of those in a bin, and how often
  they were right. --plot draws it.
- Ambiguous motions: how often the motion was said not to tell, for motions that cannot, and for exciting
  ones.

Windows of 5 s at 20 Hz with random geometry, measured with noise whose ratio of rad to m is 3.
"""

import numpy as np

import reframe_jax as rf
from reframe_jax.constraints import AngularType, ConstraintFrame, LinearType, lookup
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.uncertainty.covariance import Covariance

__all__ = ["standard_scores"]

SAMPLES, DT = 100, 0.05
INTERVAL = 1.96  # standard deviations that hold 95 %
_LEAST = 1e-12  # share of the largest variance below which a direction has none
_TRIMMED = 0.99  # share of the scores that the root of the mean square is taken of


def standard_scores(
    found: rf.Identification, covariance: Covariance, truth: ConstraintFrame, start: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors of N windows over their standard deviations, along the principal axes of the covariance.

    Args:
        found: of N windows, with the right class.
        covariance: of these.
        truth: leaves with an axis of N; one of the twelve, as :meth:`ConstraintFrame.named` orders its axes.
        start: (N, 4, 4) first true poses, at which both parts of the frame agree, m.

    Returns:
        (N, 3) of "angular" and "linear" axes, which only a class with a unique axis has, and the "position";
        NaN along directions without a variance.
    """
    matrix = np.asarray(covariance.matrix)
    entry = lookup(truth.linear_type, truth.angular_dof, truth.linear_dof)
    assert entry is not None
    axes_of_type = np.array([int(t.orientation_body) for t in LinearType])
    origin_of_type = np.array([int(t.position_body) for t in LinearType])
    turn, shift = np.asarray(start)[:, :3, :3], np.asarray(start)[:, :3, 3]

    def seen(axes: np.ndarray, fixed_in: int, wanted: np.ndarray) -> np.ndarray:
        """Axes (N, 3, n) of one body in those of another, at the start."""
        in_ground = turn @ axes if fixed_in == AngularType.B else axes
        return np.where((wanted == AngularType.B)[:, None, None], turn.mT @ in_ground, in_ground)

    frame_axes = np.asarray(rotation_exp(truth.linear_rotvec))
    fixed_in = int(truth.linear_type.orientation_body)
    scores = {}
    for name, part, odd, dof, own in (
        (
            "angular",
            found.angular,
            entry.angular_axis,
            truth.angular_dof,
            np.asarray(found.angular.type_code),
        ),
        (
            "linear",
            found.linear,
            entry.linear_axis,
            truth.linear_dof,
            axes_of_type[np.asarray(found.linear.type_code)],
        ),
    ):
        if odd is None:
            continue
        true = seen(frame_axes[:, :, odd : odd + 1], fixed_in, own)[:, :, 0]
        axis = np.asarray(rotation_exp(part.rotvec))[:, :, 2 if sum(dof) == 1 else 0]
        axis = axis * np.sign(np.sum(axis * true, axis=1))[:, None]
        block = slice(0, 3) if name == "angular" else slice(3, 6)
        scores[name] = _scores(np.cross(true, axis), matrix[:, block, block])
    body = origin_of_type[np.asarray(found.linear.type_code)]
    point = np.asarray(truth.position)
    if truth.linear_type.position_body == AngularType.B:
        point = (turn @ point[:, :, None])[:, :, 0] + shift
    in_body = (turn.mT @ (point - shift)[:, :, None])[:, :, 0]
    error = np.asarray(found.linear.position) - np.where((body == AngularType.B)[:, None], in_body, point)
    projector = np.asarray(found.linear.free_position)
    free = [i for i in range(3) if not entry.position[i]]
    if free:  # the truth moves along its own free directions, until what is left is across those found
        along = seen(frame_axes[:, :, free], fixed_in, body)
        amount = np.linalg.pinv(projector @ along, rcond=1e-3) @ projector @ error[:, :, None]
        error = error - (along @ amount)[:, :, 0]
    error = error - (projector @ error[:, :, None])[:, :, 0]
    scores["position"] = _scores(error, matrix[:, 6:9, 6:9])
    return scores


def _scores(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors (N, 3) over standard deviations, along the eigenvectors of the covariance (N, 3, 3)."""
    variances, directions = np.linalg.eigh(covariance)
    along = (error[:, None] @ directions)[:, 0]
    known = variances > _LEAST * np.maximum(variances[:, -1:], np.finfo(float).tiny)
    return np.where(known & (variances > 1e-24), along / np.sqrt(np.where(known, variances, 1)), np.nan)
