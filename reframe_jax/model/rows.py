"""Select the moments that an entry of the table needs from the moments of all features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import cross, normalize, pick, times, total, unit_matrix
from reframe_jax.model import features as z
from reframe_jax.model.steps import Problem, path_of
from reframe_jax.model.table import KINDS, PATHS, ROWS, Table

Array = jax.Array


def _picks() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places and signs of moments in (27, 27): of translations (12, 18, paths), and of the six components.

    A translation has 12 components. Its moments are those with themselves and with the six components
    of ``EntryMoments.rows``, whose features (2, 6) are given for main bodies {g} and {b}.
    """
    sixes = np.stack([np.r_[z.POSITION, turn] for turn in (z.TURN_GROUND, z.TURN_BODY)])
    places, signs = [], []
    for path in PATHS:
        rows = ROWS[KINDS.index(path)].reshape(12, z.COUNT)
        feature, sign = np.abs(rows).argmax(-1), rows.sum(-1)
        places.append(feature[:, None] * z.COUNT + np.concatenate([feature, sixes[int(path[0] == "B")]]))
        signs.append(np.outer(sign, np.concatenate([sign, np.ones(6)])))
    return np.stack(places, 2).astype(np.int32), np.stack(signs, 2), sixes


_PLACES, _SIGNS, _SIXES = _picks()
_IN_BODY = np.array([path[0] == "B" for path in PATHS])


class Forms(NamedTuple):
    """Moments at an origin of the vectors whose coordinates are held or free, in the axes of the main body.

    Attributes:
        path: (3, 3, S, ...) moments of the path of the origin.
        rows: (6, 6, S, ...) moments of the position of the body, and of the rotation.
        mixed: (3, 6, S, ...) moments of the path with the six components of ``rows``.
    """

    path: Array
    rows: Array
    mixed: Array


class EntryMoments(NamedTuple):
    """Moments that entries need; a translation is a direction times (1, origin).

    The main body of an entry is {b} if its translations are along axes of {b}, otherwise {g}.

    Attributes:
        paths: (3, 4, 3, 4, S, ...) moments of the translation, m^2, in axes of the main body.
        rows: (6, 6, S, ...) moments of the position of the body, and of the rotation.
        mixed: (3, 4, 6, S, ...) moments of the translation with the six components of ``rows``.
    """

    paths: Array
    rows: Array
    mixed: Array

    def pick(self, path: Array) -> "EntryMoments":
        """Select the moments (..., S, C, ...) of entries by the kinds of their translations (C, ...)."""
        return EntryMoments(*(pick(leaf, path, -path.ndim) for leaf in self))

    def at(self, origin: Array) -> Forms:
        """Return the moments at origins (3, ...), m."""
        _, path = path_of(self.paths, origin)
        return Forms(path, self.rows, self.mixed[:, 0] + total(self.mixed[:, 1:] * origin[:, None, None], 1))


def entry_moments(products: Array, mean: Array) -> EntryMoments:
    """Select the moments of every kind of translation, (..., S, 5, ...), from the moments of all features.

    The moments are (27, 27, S, ...), and ``mean`` (3, 3, ...) is the mean rotation.
    """
    lanes = products.ndim - 3
    signs = jnp.asarray(_SIGNS, products.dtype).reshape(*_SIGNS.shape, *[1] * (lanes + 1))
    picked = products.reshape(-1, *products.shape[2:])[_PLACES] * signs
    picked = jnp.moveaxis(picked, 2, 3)  # (12, 18, S, 5, ...)
    rest = picked.shape[2:]
    paths, mixed = picked[:, :12].reshape(3, 4, 3, 4, *rest), picked[:, 12:]
    rows = jnp.stack([products[six[:, None], six] for six in _SIXES], axis=3)  # (6, 6, S, 2, ...)
    # express the position in axes of the main body; it is measured in the ground
    unit = unit_matrix(mean.dtype, lanes) + jnp.zeros_like(mean)
    turned = jnp.stack([unit, mean], axis=2)[:, :, None]  # (3, 3, 1, 2, ...)
    for _ in range(2):  # the rows of the symmetric moments, then their columns
        rows = jnp.swapaxes(jnp.concatenate([total(turned[:, :, None] * rows[:3, None], 0), rows[3:]]), 0, 1)
    body = _IN_BODY.astype(np.int32)
    mixed = jnp.concatenate([total(turned[:, :, :, body] * mixed[:, :3, None], 1), mixed[:, 3:]], axis=1)
    return EntryMoments(paths, rows[:, :, :, body], mixed.reshape(3, 4, 6, *rest))


def in_body(entry: Table) -> Array:
    """Return whether the translations of entries are along axes of {b}, (...) bool."""
    return jnp.asarray(_IN_BODY)[entry.path]


def problem_of(
    moments: EntryMoments, details: Array, entry: Table, scale: Array, box: Array, tie: Array
) -> Problem:
    """Set up the fit of entries; the arguments are as in :class:`Problem`, with components first."""
    held = entry.held
    row = entry.apart & held[5]
    return Problem(
        turns=moments.rows[3:, 3:],
        paths=moments.paths,
        rows=moments.rows,
        held_turns=held[:3] & ~entry.crossed,
        held_paths=jnp.concatenate([held[3:5], (held[5] & ~entry.apart)[None]]),
        held_row=row,
        pitch=entry.pitch & row,
        tilted=in_body(entry),
        tie=tie,
        details=details,
        scale=scale,
        box=box,
    )


def rotation_forms(products: Array) -> Array:
    """Select the moments (3, 3, 3, 3, ...) of the elements of R from moments (27, 27, ...)."""
    return products[z.ROTATION, z.ROTATION].reshape(3, 3, 3, 3, *products.shape[2:])


def crossed_frame(ground: Array, body: Array, mean: Array) -> tuple[Array, Array]:
    """Return the frame (3, 3, ...) and tilt (2, ...) of a joint with axes (3, ...): a in {g}, b in {b}."""
    axis = times(jnp.swapaxes(mean, 0, 1), ground)
    third = normalize(axis - body * total(body * axis, 0))
    axes = jnp.stack([body, cross(third, body), third], axis=1)
    local = times(jnp.swapaxes(axes, 0, 1), axis)
    sine = jnp.sqrt(local[0] ** 2 + local[1] ** 2 + jnp.finfo(body.dtype).tiny)
    factor = jnp.where(sine < 1e-6, 1.0, jnp.arctan2(sine, local[2]) / sine)
    return axes, jnp.stack([-local[1], local[0]]) * factor
