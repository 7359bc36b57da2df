"""The catalogue of Table 2, finding a class in it, and constraint frames as pytrees."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.constraints.catalogue import CONSTRAINTS, OTHER_CONSTRAINTS, constraint, describe, lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, AxisRelation, LinearType
from reframe_jax.geometry.rotations import rotation_exp

# label: angular and linear degrees of freedom, type, unique axes, unique components of the position
TABLE_2 = {
    "A": ((0, 1, 0), (0, 0, 0), None, 1, None, "xz"),
    "B": ((0, 0, 0), (1, 0, 0), None, None, 0, ""),
    "C": ((1, 0, 0), (1, 0, 0), None, 0, 0, "yz"),
    "D": ((0, 0, 1), (1, 1, 0), None, 2, 2, ""),
    "E": ((0, 1, 0), (1, 0, 0), "BB", 1, 0, "x"),
    "F": ((0, 1, 0), (1, 0, 0), "GG", 1, 0, "x"),
    "G": ((1, 1, 1), (1, 1, 0), "BB", None, 2, "xy"),  # and z, says the paper; see Constraint.position
    "H": ((1, 1, 1), (1, 0, 0), "GG", None, 0, "xyz"),
    "I": ((0, 1, 0), (1, 0, 0), "GB", 1, 0, "xz"),
    "J": ((0, 1, 0), (1, 0, 0), "BG", 1, 0, "xz"),
    "K": ((1, 1, 1), (1, 1, 0), "GB", None, 2, "xyz"),
    "L": ((1, 1, 1), (1, 1, 0), "BG", None, 2, "xyz"),
}
PARALLEL, PERPENDICULAR, OBLIQUE = AxisRelation


def test_table_2():
    assert list(CONSTRAINTS) == list(TABLE_2)
    for label, (angular, linear, kind, angular_axis, linear_axis, unique) in TABLE_2.items():
        entry = CONSTRAINTS[label]
        assert entry.label == label
        assert entry.angular_dof == angular
        assert entry.linear_dof == linear
        assert entry.linear_type == (LinearType[kind] if kind else None)
        assert entry.angular_axis == angular_axis
        assert entry.linear_axis == linear_axis
        assert entry.position == tuple(c in unique for c in "xyz")
    assert len({entry.name for entry in CONSTRAINTS.values()}) == 12


@pytest.mark.parametrize("label", CONSTRAINTS)
def test_each_constraint_finds_itself(label):
    entry = CONSTRAINTS[label]
    kinds = list(LinearType) if entry.linear_type is None else [entry.linear_type]
    for kind in LinearType:
        found = lookup(kind, entry.angular_dof, entry.linear_dof)
        if kind in kinds:
            assert found is entry
        else:
            assert found is not entry


@pytest.mark.parametrize("label", CONSTRAINTS)
def test_the_order_of_axes_does_not_matter(label):
    entry = CONSTRAINTS[label]
    kind = LinearType.BB if entry.linear_type is None else entry.linear_type
    for order in ((1, 2, 0), (2, 0, 1), (1, 0, 2), (0, 2, 1), (2, 1, 0)):
        angular = tuple(entry.angular_dof[axis_number] for axis_number in order)
        linear = tuple(entry.linear_dof[axis_number] for axis_number in order)
        assert lookup(kind, angular, linear) is entry


def test_cylinder_and_contour_differ_by_their_axes():
    one = ((0, 0, 1), (0, 0, 1))
    for kind in LinearType:
        assert lookup(kind, *one, PARALLEL).label == "C"
        assert lookup(kind, *one).label == "C"
        assert lookup(kind, *one, OBLIQUE) is None
        assert lookup(kind, *one, None) is None
    across = {kind: lookup(kind, *one, PERPENDICULAR).label for kind in LinearType}
    assert [across[LinearType[name]] for name in ("BB", "GG", "GB", "BG")] == ["E", "F", "I", "J"]


def test_plane_contact_needs_its_axis_across_the_plane():
    for kind in LinearType:
        assert lookup(kind, (1, 0, 0), (1, 1, 0), PARALLEL).label == "D"
        assert lookup(kind, (1, 0, 0), (1, 1, 0), PERPENDICULAR) is None


def test_the_type_tells_g_from_k_from_l():
    found = {kind: lookup(kind, (1, 1, 1), (0, 1, 1)) for kind in LinearType}
    labels = {kind.name: entry and entry.label for kind, entry in found.items()}
    assert labels == {"BB": "G", "GB": "K", "GG": None, "BG": "L"}


@pytest.mark.parametrize(
    ("label", "name", "rotations", "translations", "unique"),
    [
        ("spherical", "Spherical joint", 3, 0, "xyz"),
        ("universal", "Universal joint", 2, 0, "xyz"),
        ("fixed", "Fixed", 0, 0, ""),
        ("unconstrained", "Unconstrained", 3, 3, ""),
    ],
)
def test_names_beyond_the_twelve(label, name, rotations, translations, unique):
    entry = OTHER_CONSTRAINTS[label]
    assert constraint(label.upper()) is constraint(name) is entry
    assert (sum(entry.angular_dof), sum(entry.linear_dof)) == (rotations, translations)
    assert entry.position == tuple(c in unique for c in "xyz")
    assert label not in CONSTRAINTS
    for kind in LinearType:
        for angular in itertools.product((0, 1), repeat=3):
            if sum(angular) == rotations:
                assert lookup(kind, angular, entry.linear_dof) is entry
        frame = ConstraintFrame.named(label, linear_type=kind)
        assert (frame.linear_type, frame.angular_dof, frame.linear_dof) == (
            kind,
            entry.angular_dof,
            entry.linear_dof,
        )


def test_the_constraints_beyond_the_twelve():
    assert list(OTHER_CONSTRAINTS) == ["spherical", "universal", "screw", "fixed", "unconstrained"]
    axes = {label: entry.angular_axis for label, entry in OTHER_CONSTRAINTS.items()}
    assert axes == {"spherical": None, "universal": 2, "screw": 0, "fixed": None, "unconstrained": None}
    assert OTHER_CONSTRAINTS["universal"].angular_dof == (1, 1, 0)  # z is the odd one


def test_a_screw_is_a_cylinder_joint_whose_slide_follows_the_turn():
    entry = OTHER_CONSTRAINTS["screw"]
    assert constraint("Screw JOINT") is constraint("screw") is entry
    for kind in LinearType:
        assert lookup(kind, (1, 0, 0), (1, 0, 0)) is CONSTRAINTS["C"]
        assert lookup(kind, (0, 0, 1), (0, 0, 1), screw=True) is entry
        assert lookup(kind, (0, 0, 1), (0, 0, 0), screw=True) is CONSTRAINTS["A"]
    assert lookup(LinearType.GB, (0, 0, 1), (0, 0, 1), OBLIQUE, screw=True) is None


def test_classes_without_a_name():
    cases = {
        (LinearType.GB, (1, 1, 1), (0, 0, 1)): "Unnamed: 3 rotations, 1 translation in GB",
        (LinearType.BB, (1, 1, 0), (1, 0, 0)): "Unnamed: 2 rotations, 1 translation in BB",
        (LinearType.BB, (0, 0, 0), (1, 1, 1)): "Unnamed: 0 rotations, 3 translations",
    }
    for (kind, angular, linear), text in cases.items():
        assert lookup(kind, angular, linear) is None
        assert describe(kind, angular, linear) == text
    oblique = describe(LinearType.BB, (0, 0, 1), (0, 0, 1), OBLIQUE)
    assert oblique == "Unnamed: 1 rotation, 1 translation in BB, axes oblique"


def test_constraint_by_label_or_name():
    assert constraint("k") is CONSTRAINTS["K"]
    assert constraint("Pin-plane CONTACT") is CONSTRAINTS["K"]
    with pytest.raises(KeyError, match="No constraint 'Z'") as error:
        constraint("Z")
    for entry in (CONSTRAINTS | OTHER_CONSTRAINTS).values():
        assert f"{entry.label} ({entry.name})" in str(error.value)


class TestConstraintFrame:
    @pytest.mark.parametrize("label", CONSTRAINTS)
    def test_named(self, label):
        frame, entry = ConstraintFrame.named(label), CONSTRAINTS[label]
        assert frame.angular_dof == entry.angular_dof
        assert frame.linear_dof == entry.linear_dof
        assert frame.linear_type == (entry.linear_type if entry.linear_type is not None else LinearType.BB)
        assert frame.angular_type == frame.linear_type.orientation_body
        np.testing.assert_array_equal(frame.angular_rotvec, np.zeros(3))
        np.testing.assert_array_equal(frame.linear_rotvec, np.zeros(3))
        np.testing.assert_array_equal(frame.position, [0.1, 0.3, 0.1])
        assert lookup(frame.linear_type, frame.angular_dof, frame.linear_dof) is entry

    def test_named_with_geometry(self):
        rotvec, position = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 3.0])
        frame = ConstraintFrame.named(
            "Revolute joint", linear_type=LinearType.GG, rotvec=rotvec, position=position
        )
        assert frame.linear_type is LinearType.GG
        assert frame.angular_type is AngularType.G
        np.testing.assert_array_equal(frame.position, position)
        np.testing.assert_allclose(frame.angular_axes, rotation_exp(jnp.asarray(rotvec)))
        np.testing.assert_allclose(frame.linear_axes, rotation_exp(jnp.asarray(rotvec)))

    def test_errors(self):
        with pytest.raises(KeyError, match="No constraint 'wheel'"):
            ConstraintFrame.named("wheel")
        assert ConstraintFrame.named("Hinge").angular_dof == ConstraintFrame.named("A").angular_dof
        with pytest.raises(ValueError, match="Pin-plane contact needs a GB frame, not BB"):
            ConstraintFrame.named("K", linear_type=LinearType.BB)
        assert ConstraintFrame.named("K", linear_type=LinearType.GB).linear_type is LinearType.GB

    def test_is_a_pytree_of_its_geometry(self):
        """Types and degrees of freedom are static: they stay what they are under jit and vmap."""
        frame = ConstraintFrame.named("K", position=np.arange(6.0).reshape(2, 3), rotvec=np.ones((2, 3)))
        leaves = jax.tree.leaves(frame)
        assert [leaf.shape for leaf in leaves] == [(2, 3)] * 3
        doubled = jax.jit(lambda f: jax.tree.map(lambda leaf: 2 * leaf, f))(frame)
        assert doubled.linear_type is LinearType.GB
        assert doubled.angular_dof == (1, 1, 1)
        np.testing.assert_array_equal(doubled.position, 2 * np.asarray(frame.position))
        axes = jax.vmap(lambda f: f.linear_axes)(frame)
        np.testing.assert_allclose(axes, frame.linear_axes, atol=1e-15)
