"""The catalogue of named constraints: twelve from the paper's Table 2, and five other common joints."""

from dataclasses import dataclass
from typing import Literal, cast

from reframe_jax.constraints.types import AxisRelation, Dof, LinearType, distinct_axis


@dataclass(frozen=True)
class Constraint:
    """One named constraint: its degrees of freedom, and the frame components that a motion can determine.

    Attributes:
        label: letter of the paper's Figure 2, or a word such as "spherical" for a constraint outside the
            paper.
        name: name in the paper's Table 2, or the common name of the joint.
        angular_dof, linear_dof: 1 for each free axis, 0 for each constrained axis; the axes are the same.
        linear_type: the only linear frame type that can express the constraint, or None if all four can. Both
            angular types can express every constraint.
        angular_axis, linear_axis: index of the frame axis whose direction a motion determines; None if a
            motion determines no axis.
        position: whether a motion determines each component of the position. For G, the paper lists all three
            components; a shift of a BB frame along its constrained axis z does not change the constraint, so
            z is False here.
    """

    label: str
    name: str
    angular_dof: Dof
    linear_dof: Dof
    linear_type: LinearType | None
    angular_axis: int | None
    linear_axis: int | None
    position: tuple[bool, bool, bool]


def _row(label: str, name: str, angular: str, linear: str, kind: str, unique: str) -> Constraint:
    angular_dof, linear_dof = (cast(Dof, tuple(map(int, text))) for text in (angular, linear))
    position = ("x" in unique, "y" in unique, "z" in unique)
    linear_type = LinearType[kind] if kind else None
    axes = distinct_axis(angular_dof), distinct_axis(linear_dof)
    return Constraint(label, name, angular_dof, linear_dof, linear_type, *axes, position)


CONSTRAINTS: dict[str, Constraint] = {
    row.label: row
    for row in (
        _row("A", "Revolute joint", "010", "000", "", "xz"),
        _row("B", "Prismatic joint", "000", "100", "", ""),
        _row("C", "Cylinder joint", "100", "100", "", "yz"),
        _row("D", "Plane-plane contact", "001", "110", "", ""),
        _row("E", "Planar contour following", "010", "100", "BB", "x"),
        _row("F", "Planar contour rolling", "010", "100", "GG", "x"),
        _row("G", "Cart on a curved surface", "111", "110", "BB", "xy"),
        _row("H", "Contour rolling", "111", "100", "GG", "xyz"),
        _row("I", "Planar pin-plane contact", "010", "100", "GB", "xz"),
        _row("J", "Planar plane-pin contact", "010", "100", "BG", "xz"),
        _row("K", "Pin-plane contact", "111", "110", "GB", "xyz"),
        _row("L", "Plane-pin contact", "111", "110", "BG", "xyz"),
    )
}
"""The twelve constraints of the paper's Table 2, by label."""

OTHER_CONSTRAINTS: dict[str, Constraint] = {
    row.label: row
    for row in (
        _row("spherical", "Spherical joint", "111", "000", "", "xyz"),
        _row("universal", "Universal joint", "110", "000", "", "xyz"),
        _row("screw", "Screw joint", "100", "100", "", "yz"),
        _row("fixed", "Fixed", "000", "000", "", ""),
        _row("unconstrained", "Unconstrained", "111", "111", "", ""),
    )
}
"""Named constraints that are not in the paper, by label."""

_WORDS = {
    "A": "hinge revolute",
    "B": "slide prismatic drawer",
    "C": "cylinder cylindrical",
    "D": "plane planar",
    "K": "pin",
    "spherical": "ball sphere",
    "unconstrained": "free",
}
COMMON_WORDS = {word: label for label, words in _WORDS.items() for word in words.split()}
"""Labels of constraints, by common words for them."""

_ALL = CONSTRAINTS | OTHER_CONSTRAINTS


def constraint(label: str) -> Constraint:
    """Return the catalogue entry with a given label, name or common word, in upper or lower case.

    Raises:
        KeyError: for an unknown label or name; the message lists all labels and names.
    """
    wanted = COMMON_WORDS.get(label.casefold(), label).casefold()
    for entry in _ALL.values():
        if wanted in (entry.label.casefold(), entry.name.casefold()):
            return entry
    known = ", ".join(f"{entry.label} ({entry.name})" for entry in _ALL.values())
    raise KeyError(f"No constraint {label!r}. There are: {known}.")


def _relation(angular: Dof, linear: Dof) -> AxisRelation | None:
    """Relation of the distinct axes of two aligned frames (see :func:`lookup`); None without such axes."""
    a, b = distinct_axis(angular), distinct_axis(linear)
    if a is None or b is None:
        return None
    return AxisRelation.PARALLEL if a == b else AxisRelation.PERPENDICULAR


def lookup(
    linear_type: LinearType,
    angular_dof: Dof,
    linear_dof: Dof,
    relation: AxisRelation | Literal["aligned"] | None = "aligned",
    screw: bool = False,
    universal: bool = False,
) -> Constraint | None:
    """Find the named constraint with a given linear type and given degrees of freedom.

    The lookup compares the number of free axes, not their indices, and the relation of two axes: the single
    free rotation axis, and the distinct axis of the linear frame (its single free or single constrained
    axis). They are parallel in a cylinder joint, and perpendicular on a planar contour. The angular type has
    no effect. A screw joint has the degrees of freedom of a cylinder joint; its translation is proportional
    to its rotation. A universal joint has the degrees of freedom of a spherical joint if its second axis
    turned by a large angle.

    Args:
        linear_type: the linear frame's type.
        angular_dof: 1 for each free, 0 for each constrained rotation axis.
        linear_dof: 1 for each free, 0 for each constrained translation axis.
        relation: relation of these two axes, or None if one of them does not exist. By default, both frames
            have the same axes, as in the paper's Table 2, and the degrees of freedom determine the relation.
        screw: whether the translation is proportional to the rotation.
        universal: whether the body turns about two axes only, one fixed in each body, although all three
            rotations of the frame are free.

    Returns:
        The constraint, or None if no named constraint has these degrees of freedom.
    """
    if relation == "aligned":
        relation = _relation(angular_dof, linear_dof)
    number = sum(angular_dof), sum(linear_dof)
    if universal and number == (3, 0):
        return OTHER_CONSTRAINTS["universal"]
    if screw and number == (1, 1) and relation == AxisRelation.PARALLEL:
        return OTHER_CONSTRAINTS["screw"]
    for entry in _ALL.values():
        same = number == (sum(entry.angular_dof), sum(entry.linear_dof))
        related = _relation(entry.angular_dof, entry.linear_dof) == relation
        if same and related and entry.linear_type in (None, linear_type):
            return entry
    return None


def describe(
    linear_type: LinearType, angular_dof: Dof, linear_dof: Dof, relation: AxisRelation | None = None
) -> str:
    """Describe a constraint without a name: ``"Unnamed: 3 rotations, 1 translation in GB"``.

    Args:
        linear_type: the linear frame's type.
        angular_dof: 1 for each free, 0 for each constrained rotation axis.
        linear_dof: 1 for each free, 0 for each constrained translation axis.
        relation: relation of the free rotation axis to the distinct linear axis; None if one does not exist.
    """

    def count(dof: Dof, what: str) -> str:
        return f"{sum(dof)} {what}{'' if sum(dof) == 1 else 's'}"

    # without rotation, the four linear types are equivalent
    where = f" in {linear_type}" if sum(linear_dof) < 3 and sum(angular_dof) > 0 else ""
    how = f", axes {relation.value}" if relation is not None else ""
    return f"Unnamed: {count(angular_dof, 'rotation')}, {count(linear_dof, 'translation')}{where}{how}"
