"""The table of constraints: every constraint is six coordinates of the motion, each held or free.

To add a constraint, add an entry. A coordinate is a direction times a feature vector that is measured in one
body (see :data:`KINDS`). Directions are columns of one frame: 0 and 1 are normal to its axis, 2 is the axis.
The frame has a copy in each body. An entry that uses both copies has an axis that is fixed in both bodies, up
to a small tilt. Coordinates that are written together, as in ``held("BG", 0, 1)``, are a block; a rotation of
the directions within a block changes nothing. Rotations come first, then translations, each in the order of
their columns.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.model import features as z

KINDS = ("BB", "GB", "GG", "BG", "turn in body", "turn in ground", "position", "angle between")
"""Vectors whose coordinates are held or free: the path of an origin in the four linear types, the
summed rotation in either body, the position of the body in the ground, and the direction of an axis of the
body."""

PATHS = ("BB", "GB", "GG", "BG", "position")
"""Kinds of translations."""

LINEAR_KINDS = np.array([KINDS.index(t.name) for t in LinearType])
"""(4,) codes in ``KINDS`` of the path of an origin, by ``LinearType``."""

_GROUND = {"GB", "GG", "turn in ground", "position", "angle between"}  # directions are fixed in the ground


def _weights(kind: str) -> np.ndarray:
    """(3, 4, 27): the row n'(a + B x) of a direction n and an origin x is sum n_i (1, x)_a weights[i, a]."""
    w = np.zeros((3, 4, z.COUNT))
    cross = np.cross(np.eye(3)[:, None], np.eye(3))  # e_a x e_i, (a, i, :)
    for i in range(3):
        if kind in ("position", "GB"):
            w[i, 0, z.POSITION.start + i] = 1
        elif kind == "BG":
            w[i, 0, z.IN_BODY.start + i] = -1
        elif kind in ("BB", "turn in body"):
            w[i, 0, (z.SHIFT_BODY if kind == "BB" else z.TURN_BODY).start + i] = 1
        elif kind in ("GG", "turn in ground"):
            w[i, 0, (z.SHIFT_GROUND if kind == "GG" else z.TURN_GROUND).start + i] = 1
        for a in range(3):
            if kind in ("GB", "angle between"):
                w[i, 1 + a, z.ROTATION.start + 3 * i + a] = 1  # n'R x
            elif kind == "BG":
                w[i, 1 + a, z.ROTATION.start + 3 * a + i] = 1  # n'R'x
            elif kind in ("BB", "GG"):
                w[i, 1 + a, z.TURN_BODY if kind == "BB" else z.TURN_GROUND] = cross[a, i]  # w.(x x n)
    return w


ROWS = np.stack([_weights(kind) for kind in KINDS])
"""(kinds, 3, 4, 27)."""


class Block(NamedTuple):
    """Coordinates of one kind (of ``KINDS``) along columns of the frame, which are all held or all free."""

    kind: str
    columns: tuple[int, ...]
    held: bool


def held(kind: str, *columns: int) -> Block:
    """Return a block of held coordinates, which do not change during the motion."""
    return Block(kind, columns, True)


def free(kind: str, *columns: int) -> Block:
    """Return a block of free coordinates, in which the body moves."""
    return Block(kind, columns, False)


@dataclass(frozen=True)
class Entry:
    """A constraint, in one of its representations.

    Attributes:
        label: label in the catalogue (:mod:`reframe_jax.constraints.catalogue`), or a description.
        kind: linear type of the reported frame.
        blocks: six coordinates: three of rotation, then three of translation.
        start: starting axis of the frame: "turn", the axis of the largest rotation; "normal" and "along", the
            directions in which the origin moves least and most; "lift" and "path", the directions in which
            the position of the body moves least and most; "cross", a pair of axes of a universal joint.
        any_origin: columns along which every origin is equally valid.
        pitch: whether the last coordinate is coupled with the rotation about the axis.
        tied: whether the axis of the frame is fixed in both bodies.
        parameters: number of parameters that the held coordinates determine.
    """

    label: str
    kind: LinearType
    blocks: tuple[Block, ...]
    start: str
    any_origin: tuple[int, ...]
    parameters: int
    pitch: bool = False

    @property
    def tied(self) -> bool:
        """Whether the axis of the frame is fixed in both bodies."""
        if self.start == "cross":
            return False
        return len({b.kind in _GROUND for b in self.blocks if len(b.columns) < 3}) == 2

    @property
    def dof(self) -> tuple[int, int]:
        """Numbers of free rotations and of free translations."""
        free_ones = [not b.held for b in self.blocks for _ in b.columns]
        return sum(free_ones[:3]), sum(free_ones[3:])


def _turn(kind: LinearType) -> str:
    return "turn in body" if kind.name[0] == "B" else "turn in ground"


def turning(kind: LinearType) -> Block:
    """Return a block of three free rotations, in the body that the first letter of the type names."""
    return free(_turn(kind), 0, 1, 2)


def _about_axis(kind: LinearType) -> tuple[Block, Block]:
    """Return the blocks of rotations of which only that about the axis of the frame is free."""
    return held(_turn(kind), 0, 1), free(_turn(kind), 2)


def _entries() -> tuple[Entry, ...]:
    bb, gb, gg, bg = LinearType.BB, LinearType.GB, LinearType.GG, LinearType.BG
    still, anywhere, moving = held("turn in ground", 0, 1, 2), (0, 1, 2), free("position", 0, 1, 2)
    cross = held("angle between", 2), free("turn in ground", 2), free("turn in body", 0)
    slots = {bb: "E", gg: "F", gb: "I", bg: "J"}
    surfaces = {bb: "G", gb: "K", bg: "L", gg: "3 rotations, 2 translations"}
    found = []
    for t in (bg, gb):
        turns, tip = _about_axis(t), held(t.name, 0, 1)
        found += [
            Entry("A", t, (*turns, tip, held("position", 2)), "turn", (2,), 4),
            Entry("C", t, (*turns, tip, free("position", 2)), "turn", (2,), 4),
            Entry("screw", t, (*turns, tip, held("position", 2)), "turn", (2,), 5, pitch=True),
        ]
    plane = *_about_axis(bg), free("BG", 0, 1), held("position", 2)
    found.append(Entry("D", bg, plane, "turn", anywhere, 2))
    for t in (bb, gb, gg, bg):
        slot = *_about_axis(t), held(t.name, 0), free(t.name, 1), held("position", 2)
        surface = turning(t), free(t.name, 0, 1), held(t.name, 2)
        curve = "H" if t == gg else "3 rotations, 1 translation"
        any_origin = (0, 2) if t in (bb, gg) else (2,)
        found += [
            Entry(slots[t], t, slot, "turn", any_origin, 4),
            Entry(surfaces[t], t, surface, "normal", (2,) if t == bb else (), 3),
            Entry(curve, t, (turning(t), held(t.name, 0, 1), free(t.name, 2)), "along", (), 4),
            Entry("unconstrained", t, (turning(t), free(t.name, 0, 1, 2)), "turn", anywhere, 0),
        ]
    lift = still, free("position", 0, 1), held("position", 2)
    found += [
        Entry("B", gb, (still, held("position", 0, 1), free("position", 2)), "path", anywhere, 2),
        Entry("0 rotations, 2 translations", gb, lift, "lift", anywhere, 2),
        Entry("0 rotations, 3 translations", gb, (still, moving), "path", anywhere, 0),
        Entry("1 rotation, 3 translations", gb, (*_about_axis(gb), moving), "turn", anywhere, 2),
        Entry("2 rotations, 3 translations", gb, (*cross, moving), "cross", anywhere, 3),
        Entry("fixed", gb, (still, held("position", 0, 1, 2)), "path", anywhere, 0),
    ]
    for t in (gb, bg):
        point = held(t.name, 0, 1, 2)
        stage = *_about_axis(t), held(t.name, 0), free(t.name, 1), free("position", 2)
        found += [
            Entry("1 rotation, 2 translations", t, stage, "turn", (2,), 4),
            Entry("spherical", t, (turning(t), point), "turn", (), 3),
            Entry("universal", t, (*cross, point), "cross", (), 6),
        ]
    return tuple(found)


ENTRIES = _entries()
"""All entries, in the order of their codes."""


class Table(NamedTuple):
    """The entries as arrays, E of them with six coordinates each.

    Attributes:
        kind, column: (E, 6) int.
        ground: (E, 6) bool, whether the direction is fixed in the ground.
        held: (E, 6) bool.
        together: (E, 6, 6) bool, coordinates of one block.
        pitch, tied, crossed: (E,) bool.
        parameters: (E,).
        variants: (E,) number of entries with the same blocks in any linear type, which share a prior.
        path: (E,) int, index in :data:`PATHS` of the translations along columns 0 and 1. Rotations are
            expressed in the body that its first letter names, and in the ground for "position".
        apart: (E,) bool, whether the translation along column 2 is the position, another kind than ``path``.
    """

    kind: Any
    column: Any
    ground: Any
    held: Any
    together: Any
    pitch: Any
    tied: Any
    crossed: Any
    parameters: Any
    variants: Any
    path: Any
    apart: Any


def _table(entries: tuple[Entry, ...]) -> Table:
    rows = [[(b, c, number) for number, b in enumerate(e.blocks) for c in b.columns] for e in entries]
    for e, row in zip(entries, rows, strict=True):
        columns = [c for _, c, _ in row]
        if len(row) != 6 or columns[3:] != [0, 1, 2] or (e.start != "cross" and columns[:3] != [0, 1, 2]):
            raise ValueError("Every constraint needs three rotations and three translations, by columns.")
    block = np.array([[number for _, _, number in row] for row in rows])
    # the blocks without the linear type: the entries of a family share its prior
    families = [
        (e.start, e.pitch, tuple((b.kind.startswith("turn"), b.columns, b.held) for b in e.blocks))
        for e in entries
    ]
    return Table(
        kind=np.array([[KINDS.index(b.kind) for b, _, _ in row] for row in rows], np.int32),
        column=np.array([[c for _, c, _ in row] for row in rows], np.int32),
        ground=np.array([[b.kind in _GROUND for b, _, _ in row] for row in rows]),
        held=np.array([[b.held for b, _, _ in row] for row in rows]),
        together=block[:, :, None] == block[:, None, :],
        pitch=np.array([e.pitch for e in entries]),
        tied=np.array([e.tied for e in entries]),
        crossed=np.array([e.start == "cross" for e in entries]),
        parameters=np.array([e.parameters for e in entries], np.float32),
        variants=np.array([families.count(f) for f in families], np.float32),
        path=np.array([PATHS.index(row[3][0].kind) for row in rows], np.int32),
        apart=np.array([row[3][0].kind != row[5][0].kind for row in rows]),
    )


TABLE = _table(ENTRIES)
_COLUMNS = np.concatenate([leaf.reshape(len(ENTRIES), -1) for leaf in TABLE], axis=1).T.astype(np.int32)


def entries_at(codes: jax.Array) -> Table:
    """Return the rows of the table with given codes; the axes of ``codes`` come last."""
    parts = jax.lax.split(jnp.asarray(_COLUMNS)[:, codes], [leaf[0].size for leaf in TABLE])
    pairs = zip(parts, TABLE, strict=True)
    return Table(*(part.reshape(*leaf.shape[1:], *codes.shape).astype(leaf.dtype) for part, leaf in pairs))
