"""How certain an identification is: its covariance, and the degrees of freedom that the motion tested."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from reframe_jax.compilation import Index, index_leaves
from reframe_jax.geometry import rotations

_Found = TypeVar("_Found")  # an identification, which has the classes of this module in its methods


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Excitation:
    """The degrees of freedom that a motion tested.

    Attributes:
        free: (...) int, degrees of freedom of the identified constraint.
        motions: (...) int, number of independent motions along these degrees of freedom.
        steady: (...) bool, whether a velocity, or a sum of velocities, was constant in the whole recording.
        named: (...) bool, whether the constraint has a name; if not, the motion probably missed a free axis.
    """

    free: jax.Array
    motions: jax.Array
    steady: jax.Array
    named: jax.Array

    def __getitem__(self, index: Index) -> "Excitation":
        """Windows of a batch, indexed like an array."""
        return index_leaves(self, index)

    @property
    def one_path(self) -> jax.Array:
        """(...) bool, whether the body followed a single path, as on a hinge or a rail."""
        return self.motions == 1

    @property
    def determined(self) -> jax.Array:
        """(...) bool, whether the motion determines the constraint: two or more independent, varying motions.

        If False, the identification describes the recorded motion; the mechanism may allow more.
        """
        return (self.motions > 1) & (self.motions == self.free) & ~self.steady & self.named


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Covariance:
    """First-order covariance of an identification.

    The nine components are a small rotation of the angular axes (rad), a small rotation of the linear axes
    (rad), and a shift of the origin (m). A rotation is a rotation vector in the body of the frame type; axes
    become exp(rotation vector) axes. Components without effect on the constraint, given by
    ``found.linear.free_position`` and ``free_rotation``, have zero variance. Components with an effect that
    the motion does not determine have a large standard deviation: 1 rad, or half the width of the box in
    which origins are searched (2 m or more).

    Attributes:
        matrix: (..., 9, 9) covariance of the nine components. NaN if the window failed.
        inflation: (..., 3) factor on the standard deviations of the angular axes, the linear axes and the
            origin, because of slow errors such as tracker drift: the ratio of the RMS over all directions.
            The factor is 1 if parts of the recording agree within white errors.
        first_order: (...) bool, whether a first-order covariance is valid: standard deviations of the axes
            below 0.2 rad, and of the origin below a quarter of the half width of the box. If False, errors
            may be larger.
    """

    matrix: jax.Array
    inflation: jax.Array
    first_order: jax.Array

    def __getitem__(self, index: Index) -> "Covariance":
        """Windows of a batch, indexed like an array."""
        return index_leaves(self, index)

    @property
    def angular_axes(self) -> jax.Array:
        """(..., 3, 3) rad^2, covariance of the rotation of the angular axes, in the body of their type."""
        return self.matrix[..., :3, :3]

    @property
    def linear_axes(self) -> jax.Array:
        """(..., 3, 3) rad^2, covariance of the rotation of the linear axes, in the body of their type."""
        return self.matrix[..., 3:6, 3:6]

    @property
    def position(self) -> jax.Array:
        """(..., 3, 3) m^2, covariance of the origin, in the body that the type's second letter names."""
        return self.matrix[..., 6:, 6:]

    def of(self, function: Callable[[_Found], jax.Array], found: _Found) -> jax.Array:
        """Propagate the covariance to a function of the identification, by the delta method.

        Args:
            function: differentiable function from an identification of one window to an array of n numbers.
                It may read the rotation vectors and axes of both frames, the position, and the types.
            found: the identification to which this covariance belongs, of one window or a batch.

        Returns:
            Covariance (n, n) of the n numbers, with the leading axes of ``found``.
        """

        def of_one(one: _Found, matrix: jax.Array) -> jax.Array:
            jacobian = jax.jacfwd(lambda change: jnp.ravel(function(move(one, change))))
            slope = jacobian(jnp.zeros(9, matrix.dtype))
            return slope @ matrix @ slope.T

        for _ in self.matrix.shape[:-2]:
            of_one = jax.vmap(of_one)
        return of_one(found, self.matrix)


def move(found: _Found, change: jax.Array) -> _Found:
    """Change an identification by the nine components (9,) of :class:`Covariance`."""

    def turned(rotvec: jax.Array, by: jax.Array) -> jax.Array:
        return rotations.rotation_log(rotations.rotation_exp(by) @ rotations.rotation_exp(rotvec))

    one: Any = found
    angular, linear = one.angular, one.linear
    moved: _Found = replace(
        one,
        angular=replace(angular, rotvec=turned(angular.rotvec, change[:3])),
        linear=replace(
            linear, rotvec=turned(linear.rotvec, change[3:6]), position=linear.position + change[6:]
        ),
    )
    return moved
