"""Names of the entries of the table of constraints, and the entry with given degrees of freedom."""

import numpy as np

from reframe_jax.constraints.catalogue import COMMON_WORDS, CONSTRAINTS, OTHER_CONSTRAINTS, Constraint
from reframe_jax.constraints.types import LinearType
from reframe_jax.model.table import ENTRIES

NO_ENTRY = -1
"""Code for degrees of freedom without an entry in the table."""

_CATALOGUE = CONSTRAINTS | OTHER_CONSTRAINTS


def constraint_of(code: int) -> Constraint | None:
    """Return the named constraint of an entry of the table, or None if the entry has no name."""
    return _CATALOGUE.get(ENTRIES[code].label)


def name_of(code: int) -> str:
    """Return the name of an entry, or a description such as "Unnamed: 1 rotation, 2 translations in GB"."""
    known, entry = constraint_of(code), ENTRIES[code]
    # the type has no effect without rotations or without constraints
    where = f" in {entry.kind}" if entry.dof[0] and entry.dof[1] < 3 else ""
    return f"Unnamed: {entry.label}{where}" if known is None else known.name


NAMES = tuple(dict.fromkeys(name_of(code) for code in range(len(ENTRIES))))
"""The names of all entries, without repetition."""

NAME_OF_ENTRY = np.array([NAMES.index(name_of(code)) for code in range(len(ENTRIES))], np.int32)
"""(E,) index in ``NAMES`` of the name of every entry."""

SAME_IN_ALL_TYPES = np.array(
    [
        known.linear_type is None if (known := constraint_of(code)) else not name_of(code)[-2:].isupper()
        for code in range(len(ENTRIES))
    ]
)
"""(E,) whether frames of every linear type can express the constraint of an entry."""


def codes_of(name: str) -> tuple[int, ...]:
    """Return the codes of all entries of a constraint.

    Args:
        name: a name, a label of the catalogue, or a common word such as "hinge", in upper or lower case.

    Raises:
        ValueError: for an unknown name; the message lists the labels and the common words.
    """
    wanted = COMMON_WORDS.get(name.casefold(), name).casefold()
    words_of = [(each.label.casefold(), name_of(i).casefold()) for i, each in enumerate(ENTRIES)]
    codes = tuple(i for i, both in enumerate(words_of) if wanted in both)
    if codes:
        return codes
    words = ", ".join([*_CATALOGUE, *COMMON_WORDS])
    raise ValueError(f"No constraint {name!r}; choose from {words}, or see reframe-jax constraints.")


def _class_codes() -> np.ndarray:
    """Return codes (4, 4, 4, 3) by linear type, number of free rotations and translations, and axis relation.

    The relation of distinct axes (see ``AxisRelation``) is parallel (0), perpendicular (1) or oblique (2).
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
"""(4, 4, 4, 3) entries by degrees of freedom; see :func:`_class_codes`."""
