"""How far noise shifts an estimate: what noise does on average, whatever the number of samples.

Noise adds a matrix N(x) to Sigma(x), on average, and both depend on the origin x: noise of the orientation
acts through the lever to x. The optimum of log det(Sigma + N) is therefore not that of the motion, as with
every regression on variables that have errors themselves. Where the motion leaves the constrained axes c
still and moves along the free axes f, the gradient at the true origin is

    tr(S_ff dSigma_ff) + tr(S_cc dN_cc) - 2 tr(S_cc N_cf S_ff dSigma_fc),

S_cc and S_ff being the inverses of the two blocks of Sigma. Newton's step from it is the shift, by the
Hessian less what noise adds to that. The axes turn by N_cf besides. The likeliest frame, of the constrained
axes alone, has no first term, and none of the others where N was subtracted before it was estimated.

Arrays have components first, then samples, then windows.
"""

from typing import NamedTuple

import jax

from reframe_jax.arrays import jnp
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.motion.components import cross
from reframe_jax.uncertainty.propagation import apply_to_rows

__all__ = ["PathNoise", "noise_of_path", "pull_of_noise"]


class PathNoise(NamedTuple):
    """What noise adds to the covariance of a path, along the axes of a frame.

    Attributes:
        matrix: (3, 3, N) m^2 or m^2/s^2.
        moved: (3, 3, 3, N), its derivatives by the coordinates of the origin, which come first.
        lever: (3, 3, K+1, N), derivatives of the lever along the axes by these coordinates, which come first.
        variance: (K+1, N) rad^2, of the rotations, times how often they count.
        kept_axis: see :func:`noise_of_path`, along the axes of the frame.
    """

    matrix: jax.Array
    moved: jax.Array
    lever: jax.Array
    variance: jax.Array
    kept_axis: tuple[jax.Array, jax.Array]

    def curvature(self, weight: jax.Array) -> jax.Array:
        """Second derivatives of the trace of weight (3, 3, N) times the matrix by the origin, (3, 3, N)."""
        across = _across(weight, *self.kept_axis)
        pulled = apply_to_rows(across[:, :, None], self.lever) * self.variance[None, None]
        return 2 * jnp.stack([jnp.stack([jnp.sum(a * b, axis=(0, 1)) for b in pulled]) for a in self.lever])


def noise_of_path(
    kind: jax.Array,
    rotation: jax.Array,
    position: jax.Array,
    origin: jax.Array,
    axes: jax.Array,
    kept_axis: tuple[jax.Array, jax.Array],
    weights: jax.Array,
    noise: tuple[jax.Array, jax.Array],
) -> PathNoise:
    """What noise of the poses adds to the covariance of the path of a frame's origin.

    Args:
        kind: (N,) linear type.
        rotation: (3, 3, K+1, N), of {b} in {g}.
        position: (3, K+1, N) m, of {b}.
        origin: (3, N) m, of the frame, in the body it is fixed in.
        axes: (3, 3, N) of the frame, columns.
        kept_axis: (3, N) axis in the body that the frame is oriented in, and (N,) bool, whether the noise of
            the rotations leads along it only.
        weights: (K+1, N) how often each pose counts.
        noise: (N,) m and (N,) rad, standard deviation of each component of position and orientation.
    """
    on_body, turned_by = (
        jnp.isin(kind, jnp.asarray([int(k) for k in LinearType if test(k)], kind.dtype))
        for test in (
            lambda k: k.position_body == AngularType.B,
            lambda k: k.position_body != k.orientation_body,
        )
    )
    # the lever in the body of the axes: x or R x, x - p or R^T (x - p)
    eye = jnp.eye(3, dtype=rotation.dtype)[:, :, None, None]
    turn = jnp.where(on_body[None, None, None], rotation, jnp.swapaxes(rotation, 0, 1))
    turn = jnp.where(turned_by[None, None, None], turn, eye)
    turn = apply_to_rows(jnp.swapaxes(axes, 0, 1)[:, :, None], jnp.swapaxes(turn, 0, 1))  # a row a coordinate
    lever = origin[:, None] - jnp.where(on_body[None, None], 0, position)
    lever = jnp.sum(turn * lever[:, None], axis=0)
    weighed = lever * weights[None]
    square = jnp.stack([jnp.sum(row[None] * weighed, axis=1) for row in lever])
    moved = jnp.stack([jnp.stack([jnp.sum(row[None] * weighed, axis=1) for row in each]) for each in turn])
    moved = moved + jnp.swapaxes(moved, 1, 2)
    axis, kept = kept_axis
    along = jnp.sum(axes * axis[:, None], axis=0)
    total = jnp.sum(weights, axis=0)[None, None] * jnp.eye(3, dtype=rotation.dtype)[:, :, None]
    shift, variance = jnp.square(noise[0])[None, None], jnp.square(noise[1])[None]
    matrix = shift * total + variance[None] * _across(square, along, kept)
    slopes = jnp.stack([variance[None] * _across(each, along, kept) for each in moved])
    turn = jnp.broadcast_to(turn, (3, *rotation.shape[1:]))
    return PathNoise(matrix, slopes, turn, variance * weights, (along, kept))


def _across(square: jax.Array, axis: jax.Array, kept: jax.Array) -> jax.Array:
    """The mean of (e x lever) (e x lever)^T over turns e, from that of lever lever^T, (3, 3, N).

    It is its own transpose: the trace of a weight times it is that of lever lever^T times it of the weight.
    """
    trace = square[0, 0] + square[1, 1] + square[2, 2]
    every = trace[None, None] * jnp.eye(3, dtype=square.dtype)[:, :, None] - square

    alone = cross(axis[:, None], jnp.swapaxes(cross(axis[:, None], square), 0, 1))
    return jnp.where(kept[None, None], alone, every)


def pull_of_noise(
    moved: jax.Array,
    inverses: tuple[jax.Array, jax.Array],
    noise: PathNoise,
    dof: jax.Array,
    likeliest: jax.Array,
) -> jax.Array:
    """Gradient of the objective at the true origin, on average, (3, N).

    Args:
        moved: (3, 3, 3, N), derivatives of Sigma by the coordinates of the origin, which come first.
        inverses: (3, 3, N) of its blocks of constrained and of free axes; zero elsewhere.
        noise: of the path.
        dof: (3, N), 1 where an axis is free.
        likeliest: (N,) bool, whether the constrained axes alone count.
    """
    held, free = inverses
    pulling = jnp.where(likeliest[None, None], 0, free)
    between = ((dof == 0)[:, None] & (dof == 1)[None]).astype(moved.dtype)
    mixed = noise.matrix * between
    weight = jnp.sum(held[:, :, None] * mixed[None], axis=1)
    weight = jnp.sum(weight[:, :, None] * free[None], axis=1)  # (c, f, N)
    return jnp.stack(
        [
            jnp.sum(pulling * slope + held * of_noise - 2 * weight * (slope - of_noise), axis=(0, 1))
            for slope, of_noise in zip(moved, noise.moved, strict=True)
        ]
    )
