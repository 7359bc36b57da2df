"""Products of matrices, and that none of a program's is left to the precision that a GPU takes by default."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.geometry import transforms
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.identification.velocities import frame_velocities
from reframe_jax.objectives.velocity import FrameObjective
from reframe_jax.simulation import metrics, synthetic
from reframe_jax.solvers import Box, FrameSteps


def test_products(rng):
    a, b, c = rng.normal(size=(5, 2, 3)), rng.normal(size=(5, 3, 4)), rng.normal(size=(5, 3))
    np.testing.assert_allclose(matmul(jnp.asarray(a), jnp.asarray(b)), a @ b, atol=1e-15)
    np.testing.assert_allclose(
        apply(jnp.asarray(a), jnp.asarray(c)), np.einsum("nij,nj->ni", a, c), atol=1e-15
    )


def products(jaxpr):
    """Precision of every product of matrices in a program, those of its inner programs too."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns") or hasattr(v, "jaxpr")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from products(inner)


def is_full(precision):
    highest = jax.lax.Precision.HIGHEST
    return precision is not None and all(p == highest for p in np.atleast_1d(np.asarray(precision, object)))


def check(function, *arguments):
    found = list(products(jax.make_jaxpr(function)(*arguments).jaxpr))
    assert all(is_full(precision) for precision in found), found
    return len(found)


def test_the_check_sees_products_and_their_precision():
    square = jnp.eye(3, dtype=jnp.float32)
    inner = jax.jit(lambda x: jax.lax.scan(lambda c, _: (c @ x, None), x, length=2)[0])
    assert [is_full(p) for p in products(jax.make_jaxpr(inner)(square).jaxpr)] == [False]
    assert check(jax.grad(lambda x: matmul(x, x).sum()), square) == 3


@pytest.fixture(scope="module")
def simulation():
    return synthetic.simulate("K", jax.random.key(0), noise=1e-4)


def test_of_identification(simulation):
    poses = simulation.poses.astype(jnp.float32)

    def position(poses):
        return jnp.sum(rf.identify(poses, dt=0.1).linear.position)

    assert check(jax.grad(position), poses) > 0  # its program holds that of the position


def test_of_simulation_and_maps():
    truth = rf.ConstraintFrame.named("K")
    assert check(lambda key: synthetic.simulate(truth, key, noise=1e-4).poses, jax.random.key(0)) > 0
    x = jnp.ones(6, jnp.float32)

    def maps(x):
        return transforms.pose_exp(x)

    assert check(jax.jacrev(maps), x) > 0


def test_of_errors_and_velocities(simulation):
    poses, truth = simulation.poses, simulation.truth
    found = rf.identify(poses, dt=0.1)
    assert check(lambda found: metrics.geometry_errors(found, truth, start=poses[0]), found) > 0
    assert check(lambda poses: frame_velocities(poses, jnp.full(50, 0.1), found), poses) > 0


def test_of_objectives(rng):
    objective = FrameObjective(jnp.asarray(rng.normal(size=(6, 10)), jnp.float32))
    box = Box(-jnp.ones(6, jnp.float32), jnp.ones(6, jnp.float32))
    assert check(lambda x: FrameSteps(2)(objective, box, x), jnp.full(6, 0.1, jnp.float32)) > 0


def test_of_the_robot():
    from reframe_jax.simulation import arm as panda
    from reframe_jax.simulation import reproduction

    def demonstrate(key):
        return panda.demonstrate("A", key, duration=0.2, dt=0.1, imperfections=panda.REALISTIC).poses

    assert check(demonstrate, jax.random.key(0)) > 0
    truth = jax.tree.map(lambda leaf: leaf[None], panda.frame_on_arm("A"))
    assert check(lambda p: reproduction.reproduce(truth, truth).poses, truth.position) > 0
