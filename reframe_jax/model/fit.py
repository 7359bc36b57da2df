"""Fit an entry of the table: its frame, origin, tilt and pitch.

Held blocks of coordinates are normally distributed, with an unknown covariance at each scale. The fit
minimises sum_s n_s log det (W G_s W') over the held blocks, with W(parameters) the weights of the coordinates
and G_s the moments of the features. The directions of an axis that is fixed in both bodies may differ by a
small tilt, whose size is that of the held rotations. The fit takes Levenberg-Marquardt steps on the tangent
of the logarithm, which is a sum of squares.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.model.crossed import crossed_axes
from reframe_jax.model.rows import (
    EntryMoments,
    crossed_frame,
    entry_moments,
    in_body,
    problem_of,
    rotation_forms,
)
from reframe_jax.model.steps import Unknowns, descend
from reframe_jax.model.table import KINDS, ROWS, Table

STEPS, ASSUMED_STEPS = 6, 40  # Levenberg-Marquardt steps, and those for an assumed constraint
_PARAMETERS = 9

Array = jax.Array


class Parameters(NamedTuple):
    """Parameters of an entry.

    Attributes:
        axes: (3, 3) the frame in the body; its columns are the directions of the table.
        origin: (3,) m, in the body of the linear type's second letter.
        tilt: (2,) rad, rotation from the axis in {b}, at the mean orientation, to the axis in {g}.
        pitch: () m/rad.
    """

    axes: Array
    origin: Array
    tilt: Array
    pitch: Array


class Data(NamedTuple):
    """Data of a window for the fit.

    Attributes:
        products: (S, 27, 27) moments of the features.
        details: (S,) independent details.
        mean_rotation: (3, 3).
        box: () m, half the width of the cube in which origins lie.
    """

    products: Array
    details: Array
    mean_rotation: Array
    box: Array


def ground_axes(parameters: Parameters, mean_rotation: Array) -> Array:
    """Return the axes of the frame in the ground, at the mean orientation: columns of (3, 3)."""
    tilt = jnp.concatenate([parameters.tilt, jnp.zeros_like(parameters.tilt[:1])])
    return mean_rotation @ parameters.axes @ rotation_exp(tilt)


def coordinates(parameters: Parameters, mean_rotation: Array, entry: Table) -> Array:
    """Return the matrix (6, 27) whose rows, times the 27 features of a pose, give an entry's six coordinates.

    The mean rotation (3, 3) of the body takes the axes in the body to the ground.
    """
    return coordinates_along(ground_axes(parameters, mean_rotation), parameters, entry)


def coordinates_along(axes: Array, parameters: Parameters, entry: Table) -> Array:
    """Return the matrix of :func:`coordinates` for given axes (3, 3) in the ground, as columns."""
    in_body, in_ground = parameters.axes.T, axes.T
    directions = jnp.where(entry.ground[:, None], in_ground[entry.column], in_body[entry.column])
    between = (entry.kind == KINDS.index("angle between"))[:, None]
    points = jnp.where(between, in_body[0][None], parameters.origin[None])
    points = jnp.concatenate([jnp.ones_like(points[:, :1]), points], axis=1)
    rows = jnp.asarray(ROWS, directions.dtype)[entry.kind]
    weights = jnp.einsum("ic,ia,icaf->if", directions, points, rows)
    # a screw advances with the rotation about its axis
    return weights.at[5].add(-jnp.where(entry.pitch, parameters.pitch, 0) * weights[2])


def move(parameters: Parameters, step: Array, box: Array) -> Parameters:
    """Add a step (9,) to the parameters: frame (3 rad), origin (3 m), tilt (2 rad), pitch (m/rad)."""
    return Parameters(
        parameters.axes @ rotation_exp(step[:3]),
        jnp.clip(parameters.origin + step[3:6], -box, box),
        parameters.tilt + step[6:8],
        parameters.pitch + step[8],
    )


def held_covariance(weights: Array, products: Array, entry: Table) -> Array:
    """Return the covariance of held coordinates at every scale: (S, 2, 3, 3), rotations then translations.

    Covariances between coordinates of different blocks are set to 0. A free coordinate has 1 on the diagonal,
    so the determinant ignores it.
    """
    covariance = jnp.einsum("if,sfg,jg->sij", weights, products, weights)
    both = entry.together & entry.held[:, None] & entry.held[None, :]
    lifted = jnp.where(entry.held, jnp.finfo(covariance.dtype).tiny ** 0.5, 1.0)
    covariance = jnp.where(both, covariance, 0) + jnp.diag(lifted)
    return jnp.stack([covariance[:, :3, :3], covariance[:, 3:, 3:]], axis=1)


def _log_determinants(covariance: Array) -> Array:
    """Log determinants (S,) of the covariances (S, 2, 3, 3) of rotations and translations, added up."""
    (a, b, c), (_, d, e), (_, _, f) = jnp.moveaxis(covariance, (-2, -1), (0, 1))
    det = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
    return jnp.sum(jnp.log(jnp.maximum(det, jnp.finfo(det.dtype).tiny)), axis=-1)


def objective(parameters: Parameters, data: Data, entry: Table, scale: Array, tie: Array) -> Array:
    """Compute the objective of the fit (see the module), with the cost of the tilt."""
    covariance = held_covariance(coordinates(parameters, data.mean_rotation, entry), data.products, entry)
    value = jnp.sum(data.details * _log_determinants(covariance))
    tilt_cost = jnp.sum(data.details) * jnp.log1p(jnp.sum(jnp.square(parameters.tilt)) / scale**2)
    return value + jnp.where(tie, tilt_cost, 0.0)


def fit_entry(start: Parameters, data: Data, entry: Table, mean_matrix: Array) -> Parameters:
    """Fit an entry, a row of the table, to a window from starting parameters; a tilt has no cost.

    ``mean_matrix`` (3, 3) is the mean of all R.
    """
    body = in_body(entry)
    moments = entry_moments(jnp.moveaxis(data.products, 0, -1), data.mean_rotation).pick(entry.path[None])
    moments = EntryMoments(*(leaf[..., 0] for leaf in moments))
    one = jnp.ones((), data.products.dtype)
    problem = problem_of(moments, data.details, entry, one, data.box, jnp.asarray(False))
    ground = ground_axes(start, data.mean_rotation)
    tilt = jnp.where(body, start.tilt, 0)
    pitch = jnp.where(entry.pitch, start.pitch, 0)
    inside = jnp.where(body, start.axes, ground)
    found = descend(problem, Unknowns(inside, start.origin, tilt, pitch), 2 * STEPS)
    axes = jnp.where(body, found.frame, data.mean_rotation.T @ found.frame)
    forms = rotation_forms(jnp.moveaxis(data.products, 0, -1))
    a, b, _ = crossed_axes(forms, data.details, mean_matrix, ground[:, 2], start.axes[:, 0], 2 * STEPS)
    cross_axes, cross_tilt = crossed_frame(a, b, data.mean_rotation)
    return Parameters(
        jnp.where(entry.crossed, cross_axes, axes),
        found.origin,
        jnp.where(entry.crossed, cross_tilt, found.tilt),
        found.pitch,
    )


@jax.custom_jvp
def settle(parameters: Parameters, data: Data, entry: Table, scale: Array, tie: Array) -> Parameters:
    """Return fitted parameters unchanged, with their derivatives with respect to the moments.

    The derivatives follow from the implicit function theorem: the gradient g(y, data) of the objective is 0
    at the fit, so dy = -H^-1 (dg / d data) d data. Parameters that the held coordinates do not determine have
    the derivative 0.
    """
    return parameters


def curvature(parameters: Parameters, data: Data, entry: Table, scale: Array, tie: Array) -> Array:
    """Compute the exact Hessian (9, 9) of the objective with respect to the step of :func:`move`."""
    hessian = jax.hessian(lambda step: objective(move(parameters, step, data.box), data, entry, scale, tie))
    return hessian(jnp.zeros(_PARAMETERS, data.products.dtype))


def solve_determined(hessian: Array, vector: Array, flat: float = 1e-9) -> Array:
    """Solve H y = v (9,) or (9, m), where eigenvalues of H below ``flat`` times the largest give 0."""
    size = jnp.diagonal(hessian)
    unit = jnp.sqrt(jnp.where(size > 1e-10 * jnp.max(size), size, jnp.max(size) + jnp.finfo(size.dtype).tiny))
    values, axes = jnp.linalg.eigh(hessian / unit[:, None] / unit[None])
    stiff = values > flat * jnp.max(values)
    inverse = jnp.where(stiff, 1 / jnp.where(stiff, values, 1), 0)
    shape = (-1,) + (1,) * (vector.ndim - 1)
    along = axes.T @ (vector / unit.reshape(shape))
    return (axes @ (inverse.reshape(shape) * along)) / unit.reshape(shape)


@settle.defjvp
def _settle_jvp(
    primals: tuple[Parameters, Data, Table, Array, Array],
    tangents: tuple[Parameters, Data, Table, Array, Array],
) -> tuple[Parameters, Parameters]:
    parameters, data, entry, scale, tie = primals
    zero = jnp.zeros(_PARAMETERS, data.products.dtype)

    def gradient(products: Array, mean_rotation: Array) -> Array:
        seen = data._replace(products=products, mean_rotation=mean_rotation)
        slope = jax.grad(lambda step: objective(move(parameters, step, data.box), seen, entry, scale, tie))
        return slope(zero)

    change = tangents[1].products, tangents[1].mean_rotation
    with jax.default_matmul_precision("highest"):
        _, rate = jax.jvp(gradient, (data.products, data.mean_rotation), change)
        step = -solve_determined(curvature(parameters, data, entry, scale, tie), rate)
        return parameters, jax.jvp(lambda s: move(parameters, s, data.box), (zero,), (step,))[1]
