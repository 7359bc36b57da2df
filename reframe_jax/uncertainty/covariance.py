"""The covariance of an identification, on request."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import jax
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.arrays import jnp, put
from reframe_jax.compilation import index_leaves, traced
from reframe_jax.geometry import rotations
from reframe_jax.geometry.products import matmul
from reframe_jax.identification.results import Identification, Index, PoseNoise
from reframe_jax.uncertainty.bootstrap import bootstrap_of_windows
from reframe_jax.uncertainty.estimate import covariance_of_windows
from reframe_jax.uncertainty.inputs import over_windows
from reframe_jax.uncertainty.paths import Estimates

__all__ = ["Covariance", "Errors", "Method", "covariance", "move"]

Errors = Literal["measured", "white"]
"""Whether what is left over inflates a covariance, or the noise is trusted to be white."""

Method = Literal["derivative", "bootstrap"]
"""By the derivative of the estimate by every pose, or by resampling blocks of the recording."""

_UNLIKELY = 1.35e-3  # probability of three standard deviations
_SAME_NORM = 1e-3  # relative difference between the norm and the geometric mean that rounding makes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Covariance:
    """How sure an identification is, to first order.

    Small changes of the estimate are 15 numbers: the turn of the angular axes and of the linear axes as
    rotation vectors in the bodies of their types (rad; axes become exp(turn) axes), the shift of the origin
    (m), and the changes of the RMS velocities along the angular (rad/s) and the linear axes (m/s). What is
    free has no variance: its rows are zero, and ``found.linear.free_position`` and ``free_rotation`` name it.

    Attributes:
        matrix: (..., 15, 15) mean squares and products of the errors of those numbers: their covariance and
            the products of their bias. NaN where the window failed.
        bias: (..., 15) error that the noise makes on average, whatever the number of samples: noise of the
            orientation acts through the lever to the origin and makes it look shorter. Subtract it from the
            estimate to correct that. Zero for the angular axes, the RMS, and refined frames of the types GB
            and BG, which are estimated without that noise.
        inflation: (..., 3) how much larger the standard deviations of the angular axes, the linear axes and
            the origin are than the white noise of the poses explains: 1 where it explains all.
        determined: (...) bool, whether the motion determines all that the class does not leave free; if not,
            the origin has a standard deviation of 100 m, farther than any search goes, in the directions that
            are neither free nor determined.
        first_order: (...) bool, whether the noise is small enough for a first-order covariance: along the
            constrained axes it shows at most an eighth of the motion along the slowest free one. If not, the
            true errors are larger than the covariance says.
        twin_probability: (...) that ``found.linear.twin`` is the true origin rather than the reported one, by
            the sampling distribution of the difference of their norms; 0 where there is no twin.
        type_probability: (..., 4) that each linear type, rather than the reported one, has the stiller axes,
            by the sampling distribution of the difference of their norms: 1/2 for a type that leaves over
            the same, and for the reported one. See :attr:`tied`.
    """

    matrix: jax.Array
    bias: jax.Array
    inflation: jax.Array
    determined: jax.Array
    first_order: jax.Array
    twin_probability: jax.Array
    type_probability: jax.Array

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
        return self.matrix[..., 6:9, 6:9]

    @property
    def angular_rms(self) -> jax.Array:
        """(..., 3, 3) rad^2/s^2, of the RMS along the angular axes; constrained axes show the noise."""
        return self.matrix[..., 9:12, 9:12]

    @property
    def linear_rms(self) -> jax.Array:
        """(..., 3, 3) m^2/s^2, of the RMS along the linear axes."""
        return self.matrix[..., 12:, 12:]

    @property
    def tied(self) -> jax.Array:
        """(..., 4) bool, linear types that explain the window as well: within three standard deviations.

        ``found.linear.tied`` takes the norms of two types for independent. They are not: both leave over much
        of the same noise. This compares the difference with its own standard deviation.
        """
        return self.type_probability > _UNLIKELY

    def of(self, function: Callable[[Identification], jax.Array], found: Identification) -> jax.Array:
        """Covariance of anything computed from the estimate: the delta method.

        Args:
            function: of an identification of one window, differentiable, to an array (...) of n numbers. It
                may read the rotation vectors, axes and RMS of both frames, the position, and the types.
            found: what this is the covariance of; a batch is mapped over.

        Returns:
            (n, n), with the leading axes of ``found``.
        """

        def changed(change: jax.Array, one: Identification) -> jax.Array:
            return jnp.ravel(function(move(one, change)))

        def of_one(one: Identification, matrix: jax.Array) -> jax.Array:
            slope = jax.jacfwd(changed)(jnp.zeros(15, matrix.dtype), one)
            return matmul(matmul(slope, matrix), slope.T)

        batch = self.matrix.shape[:-2]
        for _ in batch:
            of_one = jax.vmap(of_one)
        return of_one(found, self.matrix)


def move(found: Identification, change: jax.Array) -> Identification:
    """An identification with its estimate changed by the numbers (15,) of :class:`Covariance`."""

    def turned(rotvec: jax.Array, by: jax.Array) -> jax.Array:
        return rotations.rotation_log(matmul(rotations.rotation_exp(by), rotations.rotation_exp(rotvec)))

    angular, linear = found.angular, found.linear
    return replace(
        found,
        angular=replace(angular, rotvec=turned(angular.rotvec, change[:3]), rms=angular.rms + change[9:12]),
        linear=replace(
            linear,
            rotvec=turned(linear.rotvec, change[3:6]),
            position=linear.position + change[6:9],
            rms=linear.rms + change[12:],
        ),
    )


def covariance(
    found: Identification,
    poses: ArrayLike,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    noise: PoseNoise | None = None,
    errors: Errors = "measured",
    method: Method = "derivative",
    compiled: bool | None = None,
) -> Covariance:
    """Compute the covariance of an identification: of the axes, the origin, and the RMS velocities.

    To first order in the noise of the poses: the derivative of the optimum by every pose (implicit function
    theorem), times the noise. Overlapping chords and displacements share poses, which this takes into
    account. To second order, noise also shifts the estimate (``bias``), which the covariance includes.
    Trackers have slow errors besides; by default what the motion leaves along constrained axes, and for how
    long it has one sign, inflates the covariance. It holds for the types and degrees of freedom that were
    found: if these are wrong, so is the covariance.

    Args:
        found: by :func:`reframe_jax.identify` from these poses, with the default norm and discretization.
        poses: (..., K+1, 4, 4), as given to it.
        times: (K+1,) or (..., K+1) s, as given to it.
        dt: s, as given to it.
        noise: of the poses, numbers or (...); by default what the recording shows, ``found.noise``.
        errors: ``"measured"`` inflates by what is left over; ``"white"`` trusts the noise.
        method: ``"bootstrap"`` is a second way to the covariance of the axes and the origin, without a model
            of the noise: 256 sums of the moments of 48 blocks of the recording, with random weights. It knows
            no bias and costs more. For BB and GG, whose errors add up along the path, blocks say too little:
            these are estimated 128 times from poses that are disturbed by ``found.noise``.
        compiled: whether a program that JAX compiles computes it, or NumPy; see :func:`reframe_jax.identify`.

    Returns:
        The covariance, with the leading axes of ``found``.

    Raises:
        ValueError: if the poses are not those of ``found``, it was made with another norm, or the options do
            not go together.
    """
    if errors not in get_args(Errors):
        raise ValueError(f"errors must be 'measured' or 'white', not {errors!r}.")
    if method not in get_args(Method):
        raise ValueError(f"method must be 'derivative' or 'bootstrap', not {method!r}.")
    if method == "bootstrap" and (noise is not None or errors != "measured"):
        raise ValueError("The bootstrap has no model of the noise: leave out noise and errors.")
    _check_norm(found)
    if method == "bootstrap":
        return over_windows(_bootstrapped, found, poses, times, dt, compiled=compiled)
    function = _measured if errors == "measured" else _white
    return over_windows(function, found, poses, times, dt, noise, compiled)


def _check_norm(found: Identification) -> None:
    """Refuse identifications by another norm than the geometric mean."""
    if traced(found.linear.norm):
        return
    for frame in (found.angular, found.linear):
        norm, rms = np.asarray(frame.norm, float), np.asarray(frame.rms, float)
        mean = np.exp(np.mean(np.log(np.maximum(rms, 1e-300)), axis=-1))
        known = np.all(rms > 0, axis=-1)  # of exact motion, it may be too small for float32
        if np.any(known & (np.abs(norm - mean) > _SAME_NORM * mean)):
            raise ValueError(
                "The covariance holds for the default norm, the geometric mean: identify with norm=0."
            )


def _measured(poses: jax.Array, found: Estimates, steps: jax.Array, count: jax.Array | None) -> Covariance:
    return _of_windows(poses, found, steps, count, True)


def _white(poses: jax.Array, found: Estimates, steps: jax.Array, count: jax.Array | None) -> Covariance:
    return _of_windows(poses, found, steps, count, False)


def _of_windows(
    poses: jax.Array, found: Estimates, steps: jax.Array, count: jax.Array | None, measured: bool
) -> Covariance:
    failed = ~jnp.isfinite(found.position[:, 0])
    matrix, bias, inflation, determined, small, twin, types = covariance_of_windows(
        poses, steps, count, found, measured
    )
    matrix = jnp.where(failed[:, None, None], jnp.nan, matrix)
    bias, inflation = (jnp.where(failed[:, None], jnp.nan, x) for x in (bias, inflation))
    twin, types = jnp.where(failed, jnp.nan, twin), jnp.where(failed[:, None], jnp.nan, types)
    return Covariance(matrix, bias, inflation, determined & ~failed, small & ~failed, twin, types)


def _bootstrapped(
    poses: jax.Array, found: Estimates, steps: jax.Array, count: jax.Array | None
) -> Covariance:
    """By resampling; the twin is compared as always."""
    usual = _of_windows(poses, found, steps, count, False)
    failed = ~jnp.isfinite(found.position[:, 0])
    matrix = bootstrap_of_windows(poses, steps, count, found)
    matrix = jnp.where(failed[:, None, None], jnp.nan, matrix)
    number = matrix.shape[1]
    apart = put(put(usual.matrix, np.s_[:, :number], 0), np.s_[:, :, :number], 0)
    matrix = put(apart, np.s_[:, :number, :number], matrix)
    nothing = jnp.where(failed[:, None], jnp.nan, jnp.zeros_like(usual.bias))
    return replace(usual, matrix=matrix, bias=nothing, inflation=1 + nothing[:, :3])
