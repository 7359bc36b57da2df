"""The covariance of an identification, on request."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import index_leaves
from reframe_jax.geometry import rotations
from reframe_jax.identification.options import Scales
from reframe_jax.identification.results import Identification, Index
from reframe_jax.uncertainty.refit import BLOCKS, HALVES, THIRDS, Estimate, Refit, refit_windows
from reframe_jax.uncertainty.spread import distances, spread_of_fit, student_variance
from reframe_jax.uncertainty.windows import over_windows

__all__ = ["Covariance", "Errors", "Method", "covariance", "move"]

Errors = Literal["measured", "white"]
"""Whether what parts of the recording disagree by inflates a covariance, or errors count as white."""

Method = Literal["derivative", "bootstrap"]
"""By the curvature of the fit, or by fits without a part of the recording."""

_FEWEST = 8  # poses of a part that is compared
_LARGE_TURN = 0.2  # rad, standard deviation beyond which first order ends
_LARGE_SHIFT = 0.25  # of the half width of the box of origins, likewise


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Covariance:
    """How sure an identification is, to first order.

    Small changes of the estimate are nine numbers: the turn of the angular axes and of the linear axes as
    rotation vectors in the bodies of their types (rad; axes become exp(turn) axes), and the shift of the
    origin (m). What is free has no variance: the matrix is zero there (``found.linear.free_position`` and
    ``free_rotation``). What is neither free nor determined by the motion has a large one: a standard
    deviation of 1 rad, or of half the width of the box in which origins are searched (2 m or more).

    Attributes:
        matrix: (..., 9, 9) covariance of those numbers. NaN where the window failed.
        inflation: (..., 3) factor on the standard deviations of the angular axes, the linear axes and the
            origin that slow errors require: 1 where parts of the recording agree within white errors. All
            three are the same: the largest disagreement of any of them counts.
        first_order: (...) bool, whether standard deviations are small enough for a covariance: axes within
            0.2 rad, the origin within a quarter of the box. If not, errors may be larger.
    """

    matrix: jax.Array
    inflation: jax.Array
    first_order: jax.Array

    def __getitem__(self, index: Index) -> "Covariance":
        """Windows of a batch, indexed like an array."""
        return index_leaves(self, index)

    @property
    def angular_axes(self) -> jax.Array:
        """(..., 3, 3) rad^2, of the turn of the angular axes: a rotation vector in the body of their type."""
        return self.matrix[..., :3, :3]

    @property
    def linear_axes(self) -> jax.Array:
        """(..., 3, 3) rad^2, of the turn of the linear axes, likewise."""
        return self.matrix[..., 3:6, 3:6]

    @property
    def position(self) -> jax.Array:
        """(..., 3, 3) m^2, of the origin, in the body of its type's second letter."""
        return self.matrix[..., 6:, 6:]

    def of(self, function: Callable[[Identification], jax.Array], found: Identification) -> jax.Array:
        """Covariance of anything computed from the estimate: the delta method.

        Args:
            function: of an identification of one window, differentiable, to an array (...) of n numbers. It
                may read the rotation vectors and axes of both frames, the position, and the types.
            found: what this is the covariance of; a batch is mapped over.

        Returns:
            (n, n), with the leading axes of ``found``.
        """

        def changed(change: jax.Array, one: Identification) -> jax.Array:
            return jnp.ravel(function(move(one, change)))

        def of_one(one: Identification, matrix: jax.Array) -> jax.Array:
            slope = jax.jacfwd(changed)(jnp.zeros(9, matrix.dtype), one)
            return slope @ matrix @ slope.T

        for _ in self.matrix.shape[:-2]:
            of_one = jax.vmap(of_one)
        return of_one(found, self.matrix)


def move(found: Identification, change: jax.Array) -> Identification:
    """An identification with its estimate changed by the numbers (9,) of :class:`Covariance`."""

    def turned(rotvec: jax.Array, by: jax.Array) -> jax.Array:
        return rotations.rotation_log(rotations.rotation_exp(by) @ rotations.rotation_exp(rotvec))

    angular, linear = found.angular, found.linear
    return replace(
        found,
        angular=replace(angular, rotvec=turned(angular.rotvec, change[:3])),
        linear=replace(
            linear, rotvec=turned(linear.rotvec, change[3:6]), position=linear.position + change[6:]
        ),
    )


def covariance(
    found: Identification,
    poses: ArrayLike,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    scales: Scales = "auto",
    errors: Errors = "measured",
    method: Method = "derivative",
) -> Covariance:
    """Compute the covariance of an identification: of the axes and the origin.

    The entry of the table that was found is fitted again. Its objective is a likelihood in which every held
    coordinate has a variance of its own at every time scale. Its curvature gives the covariance, and the
    number of independent details the width of Student's distribution. Trackers have slow errors besides. By
    default, halves and thirds of the recording are fitted too, and the covariance is inflated by their
    disagreement, and by that of redundant coordinates: the axis from positions and that from rotations. The
    covariance holds for the types and degrees of freedom that were found: if these are wrong, so is it.

    Args:
        found: by :func:`reframe_jax.identify` from these poses, with the default norm and solver.
        poses: (..., K+1, 4, 4), as given to it.
        times: (K+1,) or (..., K+1) s, as given to it.
        dt: s, as given to it.
        scales: as given to it.
        errors: ``"measured"`` inflates by the disagreement of parts; ``"white"`` does not.
        method: ``"bootstrap"`` is a second way, without the likelihood: the entry is fitted without each of
            six blocks of the recording in turn (the grouped jackknife).

    Returns:
        The covariance, with the leading axes of ``found``.

    Raises:
        ValueError: if the poses are not those of ``found``, or the options do not go together.
    """
    if errors not in get_args(Errors):
        raise ValueError(f"errors must be 'measured' or 'white', not {errors!r}.")
    if method not in get_args(Method):
        raise ValueError(f"method must be 'derivative' or 'bootstrap', not {method!r}.")
    if method == "bootstrap" and errors != "measured":
        raise ValueError("method='bootstrap' has no model of the errors: leave out errors.")
    parts = "blocks" if method == "bootstrap" else "spans" if errors == "measured" else "whole"
    return over_windows(_of_windows, found, poses, times, dt, scales, parts=parts)


def _of_windows(
    poses: jax.Array,
    steps: jax.Array,
    count: jax.Array | None,
    found: Estimate,
    *,
    scales: tuple[int, ...] | None,
    parts: str,
) -> Covariance:
    refit, window = refit_windows(poses, steps, count, found, scales, parts)
    matrix, inflation = jax.vmap(_COMBINE[parts])(refit)
    inflation = jnp.repeat(inflation[:, None], 3, axis=1)
    angles = jnp.sqrt(jnp.diagonal(matrix, axis1=1, axis2=2))
    small = jnp.max(angles[:, :6], axis=1) < _LARGE_TURN
    near = jnp.max(angles[:, 6:], axis=1) < _LARGE_SHIFT * window.box
    failed = (window.status >= 10) | ~jnp.isfinite(found.position[:, 0])
    matrix = jnp.where(failed[:, None, None], jnp.nan, matrix)
    return Covariance(matrix, jnp.where(failed[:, None], jnp.nan, inflation), small & near & ~failed)


def _of_whole(refit: Refit) -> tuple[jax.Array, jax.Array]:
    """One window, with white errors."""
    matrix, _ = _spreads(refit)
    return matrix[0], jnp.ones((), matrix.dtype)


def _spreads(refit: Refit) -> tuple[jax.Array, jax.Array]:
    of_parts = jax.vmap(spread_of_fit, in_axes=(0, 0, 0, None, None))
    return of_parts(refit.parameters, refit.data, refit.slopes, refit.entry, refit.prior)


def _of_spans(refit: Refit) -> tuple[jax.Array, jax.Array]:
    """One window, inflated by what its halves and thirds disagree by, and by the tilt between two axes."""
    matrix, tilts = _spreads(refit)
    tilt = refit.parameters.tilt[0]
    disagreement = jnp.where(refit.entry.tied, tilt @ jnp.linalg.solve(tilts[0], tilt) / 2, 0)
    for pairs in (HALVES, THIRDS):
        i, j = np.array(pairs).T
        apart = jax.vmap(distances)(refit.numbers[i] - refit.numbers[j], matrix[i] + matrix[j])
        compared = jnp.all(refit.poses[np.array(pairs).ravel()] >= _FEWEST)
        disagreement = jnp.maximum(disagreement, jnp.where(compared, jnp.max(jnp.mean(apart, axis=0)), 0))
    inflation = jnp.sqrt(jnp.maximum(1, disagreement))
    return matrix[0] * jnp.square(inflation), inflation


def _without_blocks(refit: Refit) -> tuple[jax.Array, jax.Array]:
    """One window, by the jackknife."""
    rest = refit.numbers[1:] - jnp.mean(refit.numbers[1:], axis=0)
    matrix = rest.T @ rest * (BLOCKS - 1) / BLOCKS
    return matrix * student_variance(jnp.asarray(BLOCKS - 1.0)), jnp.ones((), matrix.dtype)


_COMBINE = {"whole": _of_whole, "spans": _of_spans, "blocks": _without_blocks}
