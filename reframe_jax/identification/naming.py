"""Names of the entries of the table, and the entry of a class."""

import numpy as np

from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS, Constraint
from reframe_jax.constraints.types import LinearType
from reframe_jax.model.table import ENTRIES, Entry

__all__ = [
    "CLASS_CODES",
    "NAMES",
    "NAME_OF_ENTRY",
    "NO_ENTRY",
    "SAME_IN_ALL_TYPES",
    "codes_of",
    "constraint_of",
    "name_of",
]

NO_ENTRY = -1
"""Code of a class that has no entry."""

_CATALOGUE = CONSTRAINTS | OTHER_CONSTRAINTS


def constraint_of(code: int) -> Constraint | None:
    """The catalogue's constraint of an entry, or None."""
    return _CATALOGUE.get(ENTRIES[code].label)


def name_of(code: int) -> str:
    """Name of an entry, of the catalogue or in words."""
    known = constraint_of(code)
    if known is not None:
        return known.name
    return _describe(ENTRIES[code])


def _describe(entry: Entry) -> str:
    """A class without a name: the type matters where something turns and something is held."""
    where = f" in {entry.kind}" if entry.dof[0] and entry.dof[1] < 3 else ""
    return f"Unnamed: {entry.label}{where}"


NAMES = tuple(dict.fromkeys(name_of(code) for code in range(len(ENTRIES))))
"""All names, without repetition."""

NAME_OF_ENTRY = np.array([NAMES.index(name_of(code)) for code in range(len(ENTRIES))], np.int32)
"""(E,) index of every entry's name."""

SAME_IN_ALL_TYPES = np.array(
    [
        known.linear_type is None
        if (known := constraint_of(code))
        else not _describe(ENTRIES[code])[-2:].isupper()
        for code in range(len(ENTRIES))
    ]
)
"""(E,) whether the constraint is the same in frames of every linear type."""


def codes_of(name: str) -> tuple[int, ...]:
    """Codes of the entries with a name, a label of the catalogue, or a common word for it.

    Raises:
        ValueError: for an unknown name; the message lists the known ones.
    """
    wanted = _COMMON.get(name.casefold(), name).casefold()
    codes = tuple(
        code
        for code, entry in enumerate(ENTRIES)
        if wanted in (entry.label.casefold(), name_of(code).casefold())
    )
    if codes:
        return codes
    known = ", ".join(
        f"{ENTRIES[int(np.argmax(code == NAME_OF_ENTRY))].label} ({each})" for code, each in enumerate(NAMES)
    )
    raise ValueError(f"No constraint {name!r}. There are: {known}; and in short {', '.join(_COMMON)}.")


_COMMON = {
    "hinge": "A",
    "revolute": "A",
    "slide": "B",
    "prismatic": "B",
    "drawer": "B",
    "cylinder": "C",
    "cylindrical": "C",
    "plane": "D",
    "planar": "D",
    "pin": "K",
    "ball": "spherical",
    "sphere": "spherical",
    "free": "unconstrained",
}


def _class_codes() -> np.ndarray:
    """Entry codes (4, 4, 4, 3) by linear type, free rotations, free translations, and relation of the axes.

    The odd axes are parallel (0), perpendicular (1) or neither (2).
    """
    codes = np.full((4, 4, 4, 3), NO_ENTRY, np.int32)
    for code in reversed(range(len(ENTRIES))):
        entry = ENTRIES[code]
        if entry.pitch:
            continue
        types = [entry.kind] if not SAME_IN_ALL_TYPES[code] else list(LinearType)
        r, t = entry.dof
        related = r in (1, 2) and t in (1, 2)
        relations = range(3) if not related else [1] if entry.label in "EFIJ" else [0]
        for kind in types:
            codes[kind, r, t, list(relations)] = code
    return codes


CLASS_CODES = _class_codes()
"""Entry of every class, see :func:`_class_codes`."""
