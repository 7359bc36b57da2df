"""Choose the next motion: the motion that would reduce the covariance most."""

from dataclasses import dataclass
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.frame import Frame, body_twist, frame_arrays
from reframe_jax.geometry.transforms import pose_exp
from reframe_jax.identification.preparation import Prepared
from reframe_jax.identification.results import Identification, check_single
from reframe_jax.model.features import pose_features
from reframe_jax.model.moments import scale_moments
from reframe_jax.motion import kinematics
from reframe_jax.uncertainty.refit import Refit, Windows, align_scales, over_windows, refit_windows
from reframe_jax.uncertainty.spread import covariances_of_motions, information

_SPEED = np.repeat([0.5, 0.1], 3)  # rad/s and m/s, amplitude of a candidate motion along an axis
_RATE = 2 * np.pi  # rad/s, one period per second
_LEAST = 1e-9  # fraction of the largest variance of axes or origin, below which a variance counts as zero


@dataclass(frozen=True)
class MotionAdvice:
    """Small motions that the constraint allows, in order of decreasing usefulness.

    Attributes:
        axes: (M, 6) bool, the axes (three angular, three linear) along which each motion moves.
        shrinks: (M,) factor by which each motion reduces the standard deviations, as the geometric mean over
            all determined components: 0.5 halves them, 1 changes nothing.
    """

    axes: np.ndarray
    shrinks: np.ndarray

    def __str__(self) -> str:
        """Describe the motions, one line per motion."""
        lines = []
        for axes, shrink in zip(self.axes, self.shrinks, strict=True):
            turns, slides = ([str(i + 1) for i in np.flatnonzero(part)] for part in (axes[:3], axes[3:]))
            parts = [f"turn about angular axis {' and '.join(turns)}"] if turns else []
            parts += [f"slide along linear axis {' and '.join(slides)}"] if slides else []
            lines.append(f"{', '.join(parts)}: standard deviations times {shrink:.2f}")
        return "\n".join(lines)


def next_motion(
    found: Identification, poses: "ArrayLike", *, times: "ArrayLike", duration: float = 2.0
) -> MotionAdvice:
    """Rank small motions by the reduction of the covariance if the recording contained them (D-optimality).

    Each motion starts from the last pose and oscillates along one or two free axes, with a period of one
    second and amplitudes of 0.5 rad/s and 0.1 m/s. The criterion is the determinant of the covariance of the
    axes and the origin, for errors as large as in the recording.

    Args:
        found: the identification of these poses by :func:`reframe_jax.identify`, of one window, with the
            default scales; its constraint is assumed to be correct.
        poses: (K+1, 4, 4) m.
        times: (K+1,) s.
        duration: s, duration of each motion.

    Returns:
        The motions, in order of decreasing usefulness.

    Raises:
        ValueError: for a batch, a failed window, a constraint without free or with coupled axes (a screw, a
            universal joint), a duration that is not positive, or poses that are not those of ``found``.
    """
    check_single(found)
    if found.status.failed or np.isfinite(found.pitch) or np.isfinite(found.universal_axes).all():
        raise ValueError(f"No motions of separate axes for this result: {found.name}.")
    if not 0 < duration < np.inf:
        raise ValueError(f"duration must be a positive number of seconds, not {duration}.")
    free = np.flatnonzero(np.concatenate([found.angular.dof, found.linear.dof]))
    if not len(free):
        raise ValueError("The identified constraint has no free axis, so no motion is possible.")
    recorded, clock = np.asarray(poses, float), np.asarray(times, float)
    step = float(np.median(np.diff(clock)))
    number = max(round(duration / step), 8)
    chosen = [*combinations(free, 1), *combinations(free, 2)]
    axes = np.zeros((len(chosen), 6), bool)
    for row, picked in zip(axes, chosen, strict=True):
        row[list(picked)] = True
    with jax.enable_x64(True):
        frame = jax.tree.map(jnp.asarray, found.constraint_frame)
        frame = frame_arrays(jax.tree.map(lambda leaf: leaf.astype(float), frame))
        centre, refit = over_windows(_fit_whole, found, recorded, clock, None, "auto")
        now, then = _spreads(frame, recorded[-1], axes * _SPEED, step, centre, refit, number=number)
    shrinks = _shrinks(np.asarray(now, float), np.asarray(then, float))
    order = np.argsort(shrinks, kind="stable")
    return MotionAdvice(axes[order], shrinks[order])


def _fit_whole(window: Prepared, windows: Windows, scales: jax.Array) -> tuple[jax.Array, Refit]:
    """Centres (N, 3), m, and fits of whole windows."""
    return window.centre, refit_windows(window, windows, scales, "whole")


@partial(jax.jit, static_argnames="number")
def _spreads(
    frame: Frame,
    last: jax.Array,
    speeds: jax.Array,
    step: float,
    centre: jax.Array,
    refit: Refit,
    *,
    number: int,
) -> tuple[jax.Array, jax.Array]:
    """Covariances of a recording (9, 9), and of the recording followed by each of M motions, (M, 9, 9)."""
    made = _move(frame, last, speeds, step, number).at[..., :3, 3].add(-centre)
    rotation, position = kinematics.split_poses(made)
    count = jnp.full(len(made), number, jnp.int32)
    features = pose_features(rotation, position, jnp.full((1, number - 1), step), count)
    moments, fit = scale_moments(features.values, jnp.ones(made.shape[:2], bool), count), refit.of_whole()
    # errors at each time scale as large as in the recording
    products, details = align_scales(moments, len(fit.details))
    details = jnp.where(fit.details > 0, details, 0)
    known = jnp.sum(information(fit, fit.products, fit.details)[0], axis=(0, 1))
    return covariances_of_motions(fit, jnp.zeros_like(products[:1]), details[:1], known)[0], (
        covariances_of_motions(fit, products, details, known)
    )


def _shrinks(now: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Geometric mean of the factors on the standard deviations, (M,), over components with a variance."""
    kinds = np.repeat(np.sqrt([max(np.trace(now[i : i + 3, i : i + 3]), 1e-30) for i in (0, 3, 6)]), 3)
    unit = np.outer(kinds, kinds)
    variances, directions = np.linalg.eigh(now / unit)
    known = variances > _LEAST * variances[-1]
    basis = directions[:, known] / np.sqrt(variances[known])
    ratio = basis.T @ (then / unit) @ basis
    return np.asarray(np.exp(np.linalg.slogdet(ratio)[1] / (2 * known.sum())))


def _move(frame: Frame, start: jax.Array, speeds: jax.Array, step: float, number: int) -> jax.Array:
    """Poses (M, number, 4, 4) from a start pose, along frame axes with velocity amplitudes (M, 6)."""

    def one(speed: jax.Array) -> jax.Array:
        # the second of two axes has a phase lag of a quarter period, so that the path is no line
        late = jnp.cumsum((speed != 0).astype(speed.dtype)) - 1

        def advance(pose: jax.Array, time: jax.Array) -> tuple[jax.Array, jax.Array]:
            velocity = speed * jnp.cos(_RATE * time + late * (jnp.pi / 2))

            def twist(pose: jax.Array) -> jax.Array:
                return body_twist(frame, pose[:3, :3], pose[:3, 3], velocity)

            half = pose @ pose_exp(twist(pose) * (step / 2))
            pose = pose @ pose_exp(twist(half) * step)
            return pose, pose

        return jax.lax.scan(advance, start, (jnp.arange(number, dtype=speed.dtype) + 0.5) * step)[1]

    return jax.vmap(one)(speeds)
