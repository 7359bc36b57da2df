"""SO(3) against SciPy and against 50-digit arithmetic: values and derivatives, both precisions."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reframe_jax.geometry.rotations import (
    hat,
    left_jacobian,
    quaternion_to_rotation,
    rotation_exp,
    rotation_log,
    rotation_to_quaternion,
    vee,
)

mp.mp.dps = 50

PI = float(np.pi)
ANGLES = (0.0, 1e-12, 1e-9, 1e-4, 0.5, 0.999, 1.0, 1.001, 3.0, PI - 1e-4, PI - 1e-9, PI)
AXES = np.array([[1.0, -2.0, 0.5], [0.0, 0.0, 1.0], [-1.0, 0.1, 0.02], [-0.3, 0.8, -1.0]])
AXES = AXES / np.linalg.norm(AXES, axis=-1, keepdims=True)
ROTVECS = np.array([angle * axis for angle in ANGLES for axis in AXES])
DTYPES = (np.float64, np.float32)

exp, log = jax.jit(rotation_exp), jax.jit(rotation_log)


# The same functions in 50 digits, written down as textbooks do.


def mp_vector(values):
    return [mp.mpf(float(x)) for x in values]


def mp_hat(w):
    return mp.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def mp_parts(w):
    angle = mp.sqrt(sum(x * x for x in w))
    return angle, mp_hat(w), mp_hat(w) ** 2


def mp_exp(w):
    angle, one, two = mp_parts(w)
    if angle == 0:
        return mp.eye(3) + one
    return mp.eye(3) + mp.sin(angle) / angle * one + (1 - mp.cos(angle)) / angle**2 * two


def mp_left_jacobian(w):
    angle, one, two = mp_parts(w)
    if angle == 0:
        return mp.eye(3) + one / 2
    return mp.eye(3) + (1 - mp.cos(angle)) / angle**2 * one + (angle - mp.sin(angle)) / angle**3 * two


def mp_left_jacobian_inverse(w):
    return mp_left_jacobian(w) ** -1


def mp_derivative(function, w):
    """(3, 3, 3) derivative of a matrix by each component: differences, exact to 30 digits."""
    step = mp.mpf(10) ** -15
    columns = []
    for i in range(3):
        up, down = list(w), list(w)
        up[i] += step
        down[i] -= step
        columns.append((function(up) - function(down)) / (2 * step))
    return np.stack([np.array(c.tolist(), dtype=float) for c in columns], axis=-1)


def to_numpy(matrix):
    return np.array(matrix.tolist(), dtype=float)


def rounding_units(actual, expected):
    """Largest error in units of the type's rounding, relative to the size of the expected values."""
    actual = np.asarray(actual)
    eps = np.finfo(actual.dtype).eps
    scale = max(1.0, float(np.max(np.abs(expected))))
    return float(np.max(np.abs(actual.astype(np.float64) - expected))) / (eps * scale)


FUNCTIONS = {
    "exp": (rotation_exp, mp_exp),
    "left_jacobian": (left_jacobian, mp_left_jacobian),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_are_exact_to_a_few_roundings(name, dtype):
    function, reference = FUNCTIONS[name]
    rotvecs = ROTVECS.astype(dtype)
    values = jax.jit(function)(jnp.asarray(rotvecs))
    assert values.dtype == dtype
    expected = np.stack([to_numpy(reference(mp_vector(w))) for w in rotvecs])
    assert rounding_units(values, expected) < 4


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_are_exact_to_a_few_roundings(name, dtype):
    function, reference = FUNCTIONS[name]
    rotvecs = ROTVECS.astype(dtype)
    expected = np.stack([mp_derivative(reference, mp_vector(w)) for w in rotvecs])
    for mode in (jax.jacfwd, jax.jacrev):
        derivatives = jax.jit(jax.vmap(mode(function)))(jnp.asarray(rotvecs))
        assert derivatives.dtype == dtype
        assert rounding_units(derivatives, expected) < 8


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_at_zero(mode):
    """Of exp: the symmetrised products of the generators."""
    second = jax.jit(mode(jax.jacfwd(rotation_exp)))(jnp.zeros(3))
    basis = np.asarray(jax.jit(hat)(jnp.eye(3)))
    expected = np.array([[(a @ b + b @ a) / 2 for a in basis] for b in basis])
    np.testing.assert_allclose(second, np.moveaxis(expected, (0, 1), (2, 3)), atol=1e-15)


@pytest.mark.parametrize("dtype", DTYPES)
def test_many_turns(dtype):
    """Far outside of the series' range neither values nor derivatives overflow."""
    rotvecs = (np.array([[30.0], [1e3], [2e6]]) * AXES[0]).astype(dtype)
    for function in (rotation_exp, left_jacobian):
        derivatives = jax.jit(jax.vmap(jax.jacrev(function)))(jnp.asarray(rotvecs))
        assert np.all(np.isfinite(derivatives))
    expected = np.stack([to_numpy(mp_exp(mp_vector(w))) for w in rotvecs])
    # the angle itself is rounded: one rounding of it is the error to expect
    for w, value, exact in zip(rotvecs, exp(jnp.asarray(rotvecs)), expected, strict=True):
        np.testing.assert_allclose(value, exact, atol=4 * np.finfo(dtype).eps * np.linalg.norm(w))


def same_rotvec(actual, expected, angle, dtype):
    """Equal, or at a half turn opposite; the angle may be rounded across pi."""
    units = rounding_units(actual, expected)
    if angle > PI - 10 * np.finfo(dtype).eps:
        units = min(units, rounding_units(-np.asarray(actual), expected))
    return units


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_inverts_exp(dtype):
    rotvecs = ROTVECS.astype(dtype)
    logs = np.asarray(log(exp(jnp.asarray(rotvecs))))
    assert logs.dtype == dtype
    for w, found in zip(rotvecs, logs, strict=True):
        angle = float(np.linalg.norm(w.astype(np.float64)))
        assert same_rotvec(found, w.astype(np.float64), angle, dtype) < 4
        if angle < 0.1:  # small rotations keep their relative accuracy
            np.testing.assert_allclose(found, w, rtol=8 * np.finfo(dtype).eps, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivative_of_log(mode, dtype):
    """Turning R by a small d changes its logarithm by the inverse left Jacobian times d."""
    rotvecs = ROTVECS.astype(dtype)
    matrices = exp(jnp.asarray(rotvecs))

    def turned(d, matrix):
        return rotation_log(rotation_exp(d) @ matrix)

    derivatives = jax.jit(jax.vmap(mode(turned)))(jnp.zeros_like(jnp.asarray(rotvecs)), matrices)
    logs = np.asarray(log(matrices))
    expected = np.stack([to_numpy(mp_left_jacobian_inverse(mp_vector(w))) for w in logs])
    assert rounding_units(derivatives, expected) < 16


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_derivative_of_log_is_finite(dtype):
    """Also off the group, where autodiff may look: by every entry, first and second."""
    matrices = exp(jnp.asarray(ROTVECS.astype(dtype)))
    tangents = jnp.ones_like(matrices)

    def both(matrix, tangent):
        return jax.jvp(jax.grad(lambda m: jnp.sum(rotation_log(m))), (matrix,), (tangent,))

    for derivative in jax.jit(jax.vmap(both))(matrices, tangents):
        assert np.all(np.isfinite(derivative))


def test_left_jacobian_is_what_it_says():
    """exp(w + h) = exp(J_l h) exp(w) to first order, by differences in 50 digits."""
    for w in ROTVECS[::7]:
        exact = mp_vector(w)
        rates = mp_derivative(mp_exp, exact)
        rotation = to_numpy(mp_exp(exact))
        turns = np.moveaxis(rates, -1, 0) @ rotation.T
        columns = np.stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]])
        np.testing.assert_allclose(jax.jit(left_jacobian)(w), columns, atol=2e-15)


@pytest.mark.parametrize("dtype", DTYPES)
def test_quaternions_against_scipy(dtype):
    rotvecs = np.concatenate([ROTVECS, -ROTVECS]).astype(dtype)
    reference = Rotation.from_rotvec(rotvecs.astype(np.float64))
    quaternions = reference.as_quat()
    matrices = jax.jit(quaternion_to_rotation)(jnp.asarray(quaternions.astype(dtype)))
    assert matrices.dtype == dtype
    assert rounding_units(matrices, reference.as_matrix()) < 4
    found = np.asarray(jax.jit(rotation_to_quaternion)(jnp.asarray(reference.as_matrix().astype(dtype))))
    assert found.dtype == dtype
    assert np.all(found[:, 3] >= 0)
    sign = np.sign(np.sum(found * quaternions, axis=-1, keepdims=True))
    assert rounding_units(found * sign.astype(dtype), quaternions) < 4


def test_derivative_of_quaternion():
    """Every branch of the extraction, the half turns about the axes included."""
    axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, 0.8]]
    units = np.array([[*axis, w] for axis in axes for w in (0, 1e-10, 0.3)] + [[0, 0, 0, 1]])
    units = units / np.linalg.norm(units, axis=-1, keepdims=True)
    matrices = jax.jit(quaternion_to_rotation)(jnp.asarray(units))

    def turned(d, matrix):
        return rotation_to_quaternion(rotation_exp(d) @ matrix)

    zeros = jnp.zeros((len(units), 3))
    found = np.asarray(jax.jit(jax.vmap(turned))(zeros, matrices))
    # the quaternion is multiplied by (d/2, 1): dq = (s d + d x v, -d.v) / 2
    cross = np.cross(np.eye(3)[None], found[:, None, :3])
    expected = np.concatenate([found[:, 3:, None] * np.eye(3) + cross, -found[:, :3, None]], axis=-1) / 2
    for mode in (jax.jacfwd, jax.jacrev):
        rates = jax.jit(jax.vmap(mode(turned)))(zeros, matrices)
        np.testing.assert_allclose(rates, np.swapaxes(expected, -1, -2), atol=1e-15)


def test_hat_and_vee(rng):
    w, x = jnp.asarray(rng.normal(size=(2, 5, 3)))
    np.testing.assert_allclose((hat(w) @ x[..., None])[..., 0], np.cross(w, x), atol=1e-15)
    np.testing.assert_array_equal(vee(hat(w)), w)
    symmetric = jnp.asarray(np.diag([1.0, 2.0, 3.0]))[None]
    np.testing.assert_array_equal(vee(hat(w) + symmetric), w)


def everything(w):
    rotation = rotation_exp(w)
    quaternion = rotation_to_quaternion(rotation)
    back = rotation_log(rotation), quaternion_to_rotation(quaternion)
    return (rotation, quaternion, left_jacobian(w), *back, hat(w), vee(rotation))


@pytest.mark.parametrize("dtype", DTYPES)
def test_leading_axes_and_dtype(dtype, rng):
    """Any batch is its rows, in the precision that came in."""
    w = jnp.asarray(rng.normal(size=(2, 3, 3)).astype(dtype))
    together = jax.jit(everything)(w)
    one = jax.jit(everything)
    single = [one(w[index]) for index in np.ndindex(2, 3)]
    for i, batch in enumerate(together):
        assert batch.dtype == dtype
        rows = np.stack([row[i] for row in single]).reshape(batch.shape)
        np.testing.assert_allclose(batch, rows, atol=4 * np.finfo(dtype).eps)


def rotation_vectors():
    """Random, nearly zero and nearly half-turn rotations."""
    angles = st.one_of(
        st.floats(0, PI),
        st.floats(-16, 0).map(lambda e: 10.0**e),
        st.floats(-16, 0).map(lambda e: PI - 10.0**e),
    )
    axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1)
    return st.tuples(angles, axes).map(lambda t: t[0] * np.array(t[1]) / np.linalg.norm(t[1]))


@settings(max_examples=100)
@given(rotation_vectors(), rotation_vectors(), rotation_vectors())
def test_group_axioms(a, b, c):
    A, B, C = (np.asarray(exp(x)) for x in (a, b, c))
    identity = np.eye(3)
    np.testing.assert_allclose(A @ A.T, identity, atol=4e-15)
    assert np.linalg.det(A) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(exp(-a), A.T, atol=1e-15)
    # closure: the logarithm of a product is a rotation vector that gives the product back
    product = np.asarray(log(A @ B))
    assert np.linalg.norm(product) <= PI + 1e-15
    np.testing.assert_allclose(exp(product), A @ B, atol=2e-14)
    # associativity, of the elements as the library stores and restores them
    np.testing.assert_allclose(exp(log(A @ B)) @ C, A @ exp(log(B @ C)), atol=4e-14)
    # conjugation turns the axis
    np.testing.assert_allclose(exp(A @ b), A @ B @ A.T, atol=2e-14)
    np.testing.assert_allclose(quaternion_to_rotation(rotation_to_quaternion(jnp.asarray(A))), A, atol=4e-15)
