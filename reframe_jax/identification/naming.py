"""Names of classes, and how probable the name of a window is."""

import jax
import numpy as np

from reframe_jax.arrays import jnp
from reframe_jax.constraints.catalogue import describe, lookup
from reframe_jax.constraints.types import ORIENTATION_BODIES, PARALLEL_COSINE, AxisRelation, Dof, LinearType

__all__ = [
    "EVEN",
    "holds_for_all_types",
    "is_universal",
    "name_class",
    "name_probability",
    "turns_about_point",
]

EVEN = 0.5
"""Probability of a name, below which all others together are more probable."""


def name_class(
    kind: LinearType,
    angular: Dof,
    linear: Dof,
    relation: AxisRelation | None,
    screw: bool = False,
    universal: bool = False,
) -> str:
    """Name of a class, of the catalogue or in words; see :func:`reframe_jax.constraints.catalogue.lookup`."""
    entry = lookup(kind, angular, linear, relation, screw, universal)
    return describe(kind, angular, linear, relation) if entry is None else entry.name


def name_probability(
    classes: jax.Array,
    winner: jax.Array,
    dof: tuple[jax.Array, jax.Array],
    axes: tuple[jax.Array, jax.Array],
    screws: jax.Array,
    universals: jax.Array,
) -> jax.Array:
    """Probability of the name of each window, (N,), as ``Identification.probability`` has it.

    Args:
        classes: (N, 4, 4, 4) probability of every linear type, number of free rotations and of translations.
        winner: (N,) linear type.
        dof: (N, 3) of both frames.
        axes: (N, 2, 3, 3) of both angular types, and (N, 3, 3) of the linear frame; columns.
        screws: (N,) probability of a screw, if one rotation is free and a translation along its axis.
        universals: (N,) probability of a universal joint, if the body turns about a point.
    """
    angular, linear = (jnp.sum(number, axis=-1) for number in dof)
    rows = jnp.arange(len(winner), dtype=winner.dtype)
    of_types = classes[rows, :, angular, linear]
    own = jnp.take_along_axis(of_types, winner[:, None], axis=1)[:, 0]
    of_name = jnp.where(holds_for_all_types(winner, dof, axes), jnp.sum(of_types, axis=1), own)
    of_name = of_name * jnp.maximum(screws, 1 - screws)
    # a universal joint has one class or the other, by how far its second axis turned
    two, three = (jnp.sum(classes[:, :, n, 0], axis=1) for n in (2, 3))
    of_point = jnp.where(is_universal(dof, universals), two + universals * three, (1 - universals) * three)
    return jnp.where(turns_about_point(dof), of_point, of_name)


def turns_about_point(dof: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Whether a body turns about more than one axis, and does not slide, (N,) bool."""
    return (jnp.sum(dof[0], axis=-1) >= 2) & (jnp.sum(dof[1], axis=-1) == 0)


def is_universal(dof: tuple[jax.Array, jax.Array], universals: jax.Array) -> jax.Array:
    """Whether a body is on a universal joint, (N,) bool; arguments as in :func:`name_probability`."""
    return turns_about_point(dof) & ((jnp.sum(dof[0], axis=-1) == 2) | (universals > EVEN))


def holds_for_all_types(
    winner: jax.Array, dof: tuple[jax.Array, jax.Array], axes: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """Whether a class, such as that of a hinge, says the same in all linear types, (N,) bool.

    Args:
        winner: (N,) linear type.
        dof: (N, 3) of both frames.
        axes: (N, 2, 3, 3) of both angular types, and (N, 3, 3) of the linear frame; columns.
    """
    angular, linear = (jnp.sum(number, axis=-1) for number in dof)
    body = jnp.asarray(ORIENTATION_BODIES)[winner]
    turning = jnp.take_along_axis(axes[0], body[:, None, None, None], axis=1)[:, 0, :, 2]
    odd = jnp.where((linear == 1)[:, None], axes[1][:, :, 2], axes[1][:, :, 0])
    parallel = jnp.abs(jnp.sum(turning * odd, axis=-1)) > PARALLEL_COSINE
    return jnp.asarray(_FOR_ALL_TYPES)[angular, linear, parallel.astype(jnp.int32)]


def _is_for_all_types(rotations: int, translations: int, parallel: bool) -> bool:
    """Whether a class has the same name in all linear types."""
    patterns: tuple[Dof, ...] = (0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1)
    related = rotations in (1, 2) and translations in (1, 2)
    relation = (AxisRelation.PARALLEL if parallel else AxisRelation.OBLIQUE) if related else None
    dof = patterns[rotations], patterns[translations]
    return len({name_class(kind, *dof, relation) for kind in LinearType}) == 1


_FOR_ALL_TYPES = np.array(
    [[[_is_for_all_types(a, b, parallel) for parallel in (False, True)] for b in range(4)] for a in range(4)]
)
