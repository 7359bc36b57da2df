"""Which motion to make next: the one that the covariance says would help most."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.located import Frame, body_twist, frame_arrays
from reframe_jax.geometry.products import matmul
from reframe_jax.geometry.transforms import pose_exp
from reframe_jax.identification.results import Identification
from reframe_jax.uncertainty.covariance import covariance

__all__ = ["MotionAdvice", "next_motion"]

_SPEED = np.repeat([0.5, 0.1], 3)  # rad/s and m/s, amplitude of a trial motion along an axis
_RATE = 2 * np.pi  # rad/s: there and back in a second
_ESTIMATE = 9  # turns and origin, of the numbers of a covariance
_LEAST = 1e-9  # share of the largest variance, of each kind, below which a direction has none


@dataclass(frozen=True)
class MotionAdvice:
    """Small motions that the constraint allows, the most useful one first.

    Attributes:
        axes: (M, 6) bool, which of the three angular and three linear axes each of them moves.
        shrinks: (M,) what each makes of the standard deviations, on average over all that is determined (the
            geometric mean): 0.5 halves them, 1 changes nothing.
    """

    axes: np.ndarray
    shrinks: np.ndarray

    def __str__(self) -> str:
        """In words, a line for each motion."""
        return "\n".join(
            f"{_in_words(axes)}: standard deviations times {shrink:.2f}"
            for axes, shrink in zip(self.axes, self.shrinks, strict=True)
        )


def _in_words(axes: np.ndarray) -> str:
    turns, slides = ([str(i + 1) for i in np.flatnonzero(part)] for part in (axes[:3], axes[3:]))
    parts = [f"turn about angular axis {' and '.join(turns)}"] if turns else []
    parts += [f"slide along linear axis {' and '.join(slides)}"] if slides else []
    return ", ".join(parts)


def next_motion(
    found: Identification,
    poses: ArrayLike,
    *,
    times: ArrayLike,
    duration: float = 2.0,
) -> MotionAdvice:
    """Rank small motions by how much the covariance shrinks when they are added to the recording (D-optimal).

    The motions start from the last pose and go along one or two of the free axes, back and forth each second,
    at up to 0.5 rad/s and 0.1 m/s. The criterion is the determinant of the covariance of the axes and the
    origin, by the noise of the recording.

    Args:
        found: of one window, by :func:`reframe_jax.identify` from these poses; its class is taken as known.
        poses: (K+1, 4, 4) m.
        times: (K+1,) s.
        duration: of each motion, s.

    Returns:
        The motions, the most useful one first.

    Raises:
        ValueError: for a batch, for a class without free axes, or if the poses are not those of ``found``.
    """
    if np.shape(found.status_code):
        raise ValueError("A batch has many constraints: index one window first, found[i].")
    free = np.flatnonzero(np.concatenate([found.angular.dof, found.linear.dof]))
    if not len(free):
        raise ValueError("The class that was found has no free axis, so that there is no motion to make.")
    recorded, clock = np.asarray(poses, float), np.asarray(times, float)
    step = float(np.median(np.diff(clock)))
    number = max(round(duration / step), 2)
    chosen = [*combinations(free, 1), *combinations(free, 2)]
    axes = np.zeros((len(chosen), 6), bool)
    for row, picked in zip(axes, chosen, strict=True):
        row[list(picked)] = True
    with jax.enable_x64(True):
        frame = jax.tree.map(lambda leaf: jnp.asarray(leaf), frame_arrays(found.constraint_frame))
        frame = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else leaf.astype(float), frame)
        made = _move(frame, jnp.asarray(recorded[-1]), jnp.asarray(axes * _SPEED), step, number=number)
        made = np.asarray(made)
    before = np.broadcast_to(recorded, (len(axes), *recorded.shape))
    longer = np.concatenate([before, made], axis=1)
    late = clock[-1] + step * np.arange(1, number + 1)
    many = jax.tree.map(
        lambda leaf: np.broadcast_to(leaf, (len(axes), *np.shape(leaf))), jax.device_get(found)
    )
    counted = np.concatenate([many.counted, np.ones((len(axes), number), bool)], axis=1)
    many = replace(many, counted=counted)
    then = covariance(many, longer, times=np.concatenate([clock, late]), errors="white")
    now = covariance(found, recorded, times=clock, errors="white")
    shrinks = _shrinks(np.asarray(now.matrix), np.asarray(then.matrix))
    order = np.argsort(shrinks, kind="stable")
    return MotionAdvice(axes[order], shrinks[order])


def _shrinks(now: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Geometric mean of the factors of standard deviations, (M,), where there is a variance now."""
    now, then = now[:_ESTIMATE, :_ESTIMATE].astype(float), then[:, :_ESTIMATE, :_ESTIMATE].astype(float)
    kinds = np.repeat(np.sqrt([max(np.trace(now[i : i + 3, i : i + 3]), 1e-30) for i in (0, 3, 6)]), 3)
    unit = np.outer(kinds, kinds)
    variances, directions = np.linalg.eigh(now / unit)
    known = variances > _LEAST * variances[-1]
    basis = directions[:, known] / np.sqrt(variances[known])
    ratio = basis.T @ (then / unit) @ basis
    return np.asarray(np.exp(np.linalg.slogdet(ratio)[1] / (2 * known.sum())))


@partial(jax.jit, static_argnames="number")
def _move(frame: Frame, start: jax.Array, speeds: jax.Array, step: float, *, number: int) -> jax.Array:
    """Poses (M, number, 4, 4) after a start, along the axes of a frame at the speeds (M, 6)."""

    def one(speed: jax.Array) -> jax.Array:
        # the second of two axes is a quarter of a period late, so that the motion does not follow one line
        late = jnp.cumsum((speed != 0).astype(speed.dtype)) - 1

        def follow(pose: jax.Array, time: jax.Array) -> tuple[jax.Array, jax.Array]:
            velocity = speed * jnp.cos(_RATE * time + late * (jnp.pi / 2))

            def twist(pose: jax.Array) -> jax.Array:
                return body_twist(frame, pose[:3, :3], pose[:3, 3], velocity)

            half = matmul(pose, pose_exp(twist(pose) * (step / 2)))
            pose = matmul(pose, pose_exp(twist(half) * step))
            return pose, pose

        times = (jnp.arange(number, dtype=speed.dtype) + 0.5) * step
        return jax.lax.scan(follow, start, times)[1]

    return jax.vmap(one)(speeds)
