"""The moments that an entry of the table needs, picked out of those of all features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import cross, normalize, sandwich, times, total
from reframe_jax.model import features as z
from reframe_jax.model.steps import Problem, Unknowns, axis_row, path_of, row_size
from reframe_jax.model.table import KINDS, PATHS, ROWS, Table

__all__ = [
    "EntryMoments",
    "coordinates_at",
    "crossed_frame",
    "gather_moments",
    "in_body",
    "path_moments",
    "problem_of",
    "rotation_forms",
]

Array = jax.Array


def _picks() -> tuple[np.ndarray, np.ndarray]:
    """Places in (27, 27) and signs, (paths, turns, 252), of the moments of :class:`EntryMoments`."""
    places, signs = [], []
    for path in PATHS:
        rows = ROWS[KINDS.index(path)].reshape(12, z.COUNT)
        feature, sign = np.abs(rows).argmax(-1), rows.sum(-1)
        for turns in (z.TURN_BODY, z.TURN_GROUND):
            six = np.r_[z.POSITION, turns]
            pairs = (feature, feature), (six, six), (feature, six)
            place = [one[:, None] * z.COUNT + other for one, other in pairs]
            places.append(np.concatenate([p.ravel() for p in place]))
            signs.append(np.concatenate([np.outer(sign, sign).ravel(), np.ones(36), np.repeat(sign, 6)]))
    shape = len(PATHS), 2, -1
    return np.stack(places).reshape(shape).astype(np.int32), np.stack(signs).reshape(shape)


_PLACES, _SIGNS = _picks()
_IN_BODY = np.array([path[0] == "B" for path in PATHS])


class EntryMoments(NamedTuple):
    """Moments that an entry needs; a translation is a direction times (1, origin).

    Attributes:
        paths: (3, 4, 3, 4, S, ...) of the translation.
        rows: (6, 6, S, ...) of the position of the body, in the ground, and of the rotation.
        mixed: (3, 4, 6, S, ...) of the translation with those.
    """

    paths: Array
    rows: Array
    mixed: Array

    def in_main_axes(self, mean: Array, body: Array) -> "EntryMoments":
        """The position in axes of the main body, where that is the moving one."""
        unit = jnp.eye(3, dtype=mean.dtype).reshape(3, 3, *[1] * (mean.ndim - 2))
        turned = jnp.where(body, mean, unit)
        zero = jnp.zeros_like(turned)
        halves = [jnp.concatenate([turned, zero], axis=1), jnp.concatenate([zero, zero + unit], axis=1)]
        outer = jnp.concatenate(halves)
        mixed = total(self.mixed[:, :, :, None] * outer[None, None, :, :, None], 2)
        return EntryMoments(self.paths, sandwich(outer, self.rows), mixed)


def in_body(entry: Table) -> Array:
    """Whether the axes of an entry's translations belong to the body."""
    return jnp.asarray(_IN_BODY)[entry.path]


def gather_moments(products: Array, path: Array, turn: Array) -> EntryMoments:
    """Moments of an entry, of its kinds of translations and rotations.

    Args:
        products: (S, 27, 27) of a window.
        path: (...) int, as in the table.
        turn: (...) int, as in the table.
    """
    places, signs = jnp.asarray(_PLACES)[path, turn], jnp.asarray(_SIGNS, products.dtype)[path, turn]
    flat = products.reshape(products.shape[0], -1)
    return _split_moments(jnp.moveaxis(flat[:, places] * signs, -1, 0))


def path_moments(products: Array) -> Array:
    """Moments (3, 4, 3, 4, S, 4, ...) of the paths of the linear types, of moments (27, 27, S, ...)."""
    places, signs = _PLACES[:4, 0, :144].T, jnp.asarray(_SIGNS[:4, 0, :144].T, products.dtype)
    picked = products.reshape(-1, *products.shape[2:])[places]
    picked = picked * signs.reshape(*signs.shape, *[1] * (picked.ndim - 2))
    return jnp.moveaxis(picked, 1, 2).reshape(3, 4, 3, 4, *products.shape[2:3], 4, *products.shape[3:])


def _split_moments(picked: Array) -> EntryMoments:
    """Moments by group, of all of them (252, S, ...)."""
    rest = picked.shape[1:]
    return EntryMoments(
        picked[:144].reshape(3, 4, 3, 4, *rest),
        picked[144:180].reshape(6, 6, *rest),
        picked[180:].reshape(3, 4, 6, *rest),
    )


def problem_of(
    moments: EntryMoments, details: Array, entry: Table, scale: Array, box: Array, tie: Array
) -> Problem:
    """The fit of entries, of moments in axes of their main body; components of all arguments come first."""
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


def coordinates_at(moments: EntryMoments, at: Unknowns, apart: Array) -> tuple[Array, Array, Array]:
    """Moments of the coordinates of entries: rotations, translations, and both, (3, 3, S, ...) each.

    Args:
        moments: in axes of the main body.
        at: frame, origin, tilt and pitch.
        apart: (...) bool, as in the table.
    """
    _, path = path_of(moments.paths, at.origin)
    x = at.origin[:, None, None]
    cross = moments.mixed[:, 0] + total(moments.mixed[:, 1:] * x, 1)
    frame = at.frame
    turns, shifts = sandwich(frame, moments.rows[3:, 3:]), sandwich(frame, path)
    half = total(cross[:, None, 3:] * frame[:, :, None, None], 0)
    mixed = total(half[None] * jnp.swapaxes(frame, 0, 1)[:, None, :, None], 2)
    moved, size = row_size(moments.rows, axis_row(at))
    along = total(moved[3:, None] * frame[:, :, None], 0)
    third = (np.arange(3) == 2).reshape(3, *[1] * (along.ndim - 1))
    mixed = jnp.where(apart & third[None], along[:, None], mixed)
    return turns, jnp.where(apart & third[:, None] & third[None], size, shifts), mixed


def rotation_forms(products: Array) -> Array:
    """Moments (3, 3, 3, 3, ...) of the entries of R, of moments (27, 27, ...)."""
    return products[z.ROTATION, z.ROTATION].reshape(3, 3, 3, 3, *products.shape[2:])


def crossed_frame(ground: Array, body: Array, mean: Array) -> tuple[Array, Array]:
    """Axes (3, 3, ...) and tilt (2, ...) of a universal joint with the axes a and b, (3, ...)."""
    axis = times(jnp.swapaxes(mean, 0, 1), ground)
    third = normalize(axis - body * total(body * axis, 0))
    axes = jnp.stack([body, cross(third, body), third], axis=1)
    local = times(jnp.swapaxes(axes, 0, 1), axis)
    sine = jnp.sqrt(local[0] ** 2 + local[1] ** 2 + jnp.finfo(body.dtype).tiny)
    factor = jnp.where(sine < 1e-6, 1.0, jnp.arctan2(sine, local[2]) / sine)
    return axes, jnp.stack([-local[1], local[0]]) * factor
