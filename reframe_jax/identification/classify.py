"""From optima to a classification: degrees of freedom, what is free, which types tie."""

from dataclasses import dataclass

import jax

from reframe_jax.arrays import jnp, nn
from reframe_jax.geometry import symmetric
from reframe_jax.geometry.products import matmul3
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.objectives.moments import MONOMIALS

__all__ = [
    "Thresholds",
    "class_probabilities",
    "degrees_of_freedom",
    "excess_over",
    "free_positions",
    "free_rotations",
    "likeliest_type",
    "nearest_origin",
    "tie_margin",
    "tied_types",
]

_NOISE_MARGIN = 3.0
_STILL_MARGIN = 2.0
_TIE_DEVIATIONS = 3.0
_NOISE_CORRELATION = 1.5  # variance of a mean square of differenced white noise, against white noise
_WORTH = 15.0  # independent numbers that any number of them is worth at most, where types are compared


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Thresholds:
    """RMS velocities above which an axis counts as free.

    The defaults are the midpoints of the ranges that classify the paper's robot data (section 5.6).

    Attributes:
        angular: rad/s.
        linear: m/s.
    """

    angular: float | jax.Array = 0.160
    linear: float | jax.Array = 0.037


def degrees_of_freedom(rms: jax.Array, threshold: jax.Array | float) -> jax.Array:
    """1 where an axis is free, (..., 3) int32; a constrained axis has an RMS below the threshold."""
    return (rms > threshold).astype(jnp.int32)


def free_rotations(dof: jax.Array) -> jax.Array:
    """Axes about which a frame can turn freely, (..., 3) bool: the other two are of one kind."""
    return jnp.roll(dof, 1, axis=-1) == jnp.roll(dof, -1, axis=-1)


def free_positions(
    moments: jax.Array,
    axes: jax.Array,
    dof: jax.Array,
    position: jax.Array,
    still: jax.Array,
    noise: jax.Array,
) -> jax.Array:
    """Directions in which the origin can move without changing the velocity of constrained axes.

    Moving the origin by d changes the velocity by B d. The direction is free if what changes along
    the constrained axes, per metre, is no more than the noise in the angular velocity, and if moving
    from the optimum to the centre of the motion changes them by no more than what they show already.

    Args:
        moments: (6, 10, ...).
        axes: (..., 3, 3), columns are the axes.
        dof: (..., 3).
        position: (..., 3) m from the centre of the motion, the optimum.
        still: (...) m/s, largest RMS of the constrained axes.
        noise: (...) rad/s, RMS of what counts as no rotation.

    Returns:
        (..., 3, 3) projectors.
    """
    constrained = (dof == 0).astype(axes.dtype)
    weight = symmetric.from_matrix(matmul3(axes * constrained[..., None, :], jnp.swapaxes(axes, -1, -2)))
    pull = []
    for a, b in INDEX_PAIRS:
        column = moments[:, MONOMIALS.index((a + 1, b + 1))]
        total = symmetric.trace_product(weight, tuple(column[i] for i in range(6)))  # type: ignore[arg-type]
        pull.append(total if a == b else total / 2)
    strengths, directions = symmetric.eigh(tuple(pull))  # type: ignore[arg-type]
    basis = jnp.stack([jnp.stack(direction, axis=-1) for direction in directions], axis=-1)
    # what moving the origin changes along all axes, free ones too
    squares = [moments[i, MONOMIALS.index((a, a))] for i in (0, 3, 5) for a in (1, 2, 3)]
    rounding = 64 * jnp.finfo(axes.dtype).eps * jnp.sum(jnp.stack(squares), axis=0)
    limit = jnp.maximum(jnp.square(_NOISE_MARGIN * noise), rounding)[..., None]
    strength = jnp.stack(strengths, axis=-1)
    change = strength * jnp.square(matmul3(position[..., None, :], basis)[..., 0, :])
    small = change <= jnp.square(_STILL_MARGIN * still)[..., None]
    free = ((strength <= limit) & small).astype(axes.dtype)
    return matmul3(basis * free[..., None, :], jnp.swapaxes(basis, -1, -2))


def nearest_origin(
    moments: jax.Array, axes: jax.Array, dof: jax.Array, rms: jax.Array, position: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of all origins that give the same constraint, the one nearest to the centre of the motion.

    Args:
        moments: (6, 10, ...).
        axes: (..., 3, 3), columns are the axes.
        dof: (..., 3).
        rms: (..., 3) m/s, along the axes.
        position: (..., 3) m from the centre of the motion, the optimum.
        noise: (...) rad/s, RMS of what counts as no rotation.

    Returns:
        Projectors onto the free directions, (..., 3, 3), and that origin, (..., 3) m.
    """
    still = jnp.max(jnp.where(dof == 0, rms, 0), axis=-1)
    free = free_positions(moments, axes, dof, position, still, noise)
    return free, position - matmul3(free, position[..., None])[..., 0]


def excess_over(reference: jax.Array, rms: jax.Array, counted: jax.Array) -> jax.Array:
    """How much faster axes are than those of a reference, in the logarithm of their geometric mean.

    Args:
        reference: (..., 3) RMS velocities, ascending.
        rms: (..., 3) those compared with it.
        counted: (..., 3) 1 for axes that are compared, 0 for others, in the type of ``rms``.

    Returns:
        (...).
    """
    total = jnp.sum(counted * (jnp.log(rms) - jnp.log(reference)), axis=-1)
    return total / jnp.maximum(jnp.sum(counted, axis=-1), 1)


def _independent_numbers(axes: jax.Array | int, samples: jax.Array | int) -> jax.Array:
    """How many independent numbers velocities along n axes are, from K samples: n K / c.

    c = 1.5, because differencing correlates neighbours.
    """
    return jnp.asarray(axes * samples / _NOISE_CORRELATION)


def tie_margin(counted: jax.Array, samples: jax.Array | int) -> jax.Array:
    """What :func:`excess_over` may be, (...), for a tie: three standard deviations of a difference.

    From N independent numbers the logarithm of a root mean square is known to about sqrt(1 / (2 N)).
    """
    number = jnp.maximum(jnp.sum(counted, axis=-1), 1)
    return _TIE_DEVIATIONS / jnp.sqrt(_independent_numbers(number, samples))


def tied_types(rms: jax.Array, dof: jax.Array, winner: jax.Array, samples: jax.Array | int) -> jax.Array:
    """Types whose constrained axes are as still as the winner's, to within sampling error.

    Compared is the geometric mean of the RMS along as many axes as the winner has constrained: the
    velocity of free axes says nothing about a constraint. See :func:`tie_margin`. A winner without
    constrained axes is no constraint, and ties with every type.

    Args:
        rms: (..., T, 3) ascending, of every type.
        dof: (..., T, 3).
        winner: (...) index of the winning type.
        samples: (...) independent velocities.

    Returns:
        (..., T) bool.
    """

    def of_winner(array: jax.Array) -> jax.Array:
        return jnp.take_along_axis(array, winner[..., None, None], axis=-2)

    counted = (of_winner(dof) == 0).astype(rms.dtype)
    excess = excess_over(of_winner(rms), rms, counted)
    number = jnp.broadcast_to(jnp.asarray(samples, rms.dtype), winner.shape)[..., None]
    return (jnp.sum(counted, axis=-1) == 0) | (excess < tie_margin(counted, number))


def class_probabilities(
    patterns: jax.Array, rms: jax.Array, dof: jax.Array, winner: jax.Array, samples: jax.Array
) -> jax.Array:
    """Probability of every class, (N, 4, 4, 4): linear type, number of free rotations, of free translations.

    Types are compared along as many axes as the type of the lowest norm has constrained. What is left along
    them is Gaussian of a size that is not known, so that of n independent numbers the logarithm of the
    likelihood is - n log rms. Errors do not act on all types alike, which makes many numbers worth no more
    than a few of them.

    Args:
        patterns: (4, 4, N, 4) probability of every pattern if the type were known.
        rms: (N, 4, 3) m/s, ascending, of every type.
        dof: (N, 4, 3) of every type.
        winner: (N,) the type of the lowest norm.
        samples: (N,) independent velocities.
    """
    counted = (jnp.take_along_axis(dof, winner[:, None, None], axis=1)[:, 0] == 0).astype(rms.dtype)
    number = jnp.maximum(jnp.sum(counted, axis=1), 1)
    worth = 1 / (1 / _independent_numbers(number, samples) + 1 / _WORTH)
    size = jnp.sum(counted[:, None] * jnp.log(rms), axis=2) / number[:, None]
    of_types = nn.softmax(-worth[:, None] * size, axis=1)
    return of_types[:, :, None, None] * jnp.moveaxis(patterns, (2, 3), (0, 1))


def likeliest_type(classes: jax.Array, winner: jax.Array) -> jax.Array:
    """The likeliest linear type, (N,); where all are as likely, the winner (N,)."""
    of_types = jnp.sum(classes, axis=(2, 3))
    own = jnp.take_along_axis(of_types, winner[:, None], axis=1)[:, 0]
    likeliest = jnp.argmax(of_types, axis=1).astype(winner.dtype)
    return jnp.where(own < jnp.max(of_types, axis=1), likeliest, winner)
