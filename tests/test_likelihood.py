"""The likeliest frame of a class: the constrained axes alone, without the noise of the orientation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import reframe_jax as rf
from benchmarks.bounds import cramer_rao
from benchmarks.determined import Told
from benchmarks.fits import Windows, scores
from reframe_jax.geometry import symmetric
from reframe_jax.objectives.held_axes import HeldAxesObjective
from reframe_jax.objectives.moments import velocity_moments
from reframe_jax.simulation.metrics import dof_correct, types_correct
from reframe_jax.simulation.motions import PoseErrors, random_motion

SAMPLES, DT, WINDOWS = 50, 0.1, 96


@pytest.mark.parametrize("held", [(1, 0, 0), (1, 1, 0), (1, 1, 1)])
def test_the_objective_and_its_derivatives(held):
    maps = np.random.default_rng(0).normal(size=(40, 3, 4)) * np.array([1e-2, 0.1, 1])[:, None]
    objective = HeldAxesObjective(velocity_moments(jnp.asarray(maps)), jnp.asarray(held, float))
    x = jnp.asarray([0.3, -0.2, 0.1])
    velocities = maps[..., 0] + maps[..., 1:] @ np.asarray(x)
    variances = np.linalg.eigvalsh(velocities.T @ velocities / len(maps))
    assert objective.value(x) == pytest.approx(np.sum(np.log(variances) * held))
    slope, curvature = objective.slope_and_curvature(x)
    np.testing.assert_allclose(slope, jax.grad(objective.value)(x), rtol=1e-9)
    np.testing.assert_allclose(symmetric.to_matrix(curvature), jax.hessian(objective.value)(x), rtol=1e-8)


def negative_log_likelihood(origin, normal, poses, noise):
    """Of a point of the body on a plane: residuals with the noise of every pose, its lever included."""
    lever = poses[:, :3, :3] @ origin
    heights = (poses[:, :3, 3] + lever) @ normal
    variance = noise[0] ** 2 + noise[1] ** 2 * np.sum(np.cross(lever, normal) ** 2, axis=1)
    heights = heights - np.sum(heights / variance) / np.sum(1 / variance)
    return np.sum(heights**2 / variance + np.log(variance)) / 2


@pytest.mark.parametrize("sigma", [2e-4, 1e-3])
def test_a_pin_on_a_plane_is_at_the_maximum_of_the_likelihood(sigma):
    """Of motion that tells little, too: there the optimum of all axes is several standard deviations off."""

    def one(key):
        errors = PoseErrors(sigma=sigma)
        return random_motion("K", key, samples=SAMPLES, dt=DT, excitation="hand", errors=errors)

    made = jax.vmap(one)(jax.random.split(jax.random.key(11), WINDOWS))
    poses = np.asarray(made.poses)
    found = rf.identify(poses, dt=DT)
    right = np.asarray(types_correct(found, made.truth) & dof_correct(found, made.truth) & found.refined)
    assert right.mean() > 0.6
    losses = []
    for i in np.flatnonzero(right):
        basis = np.asarray(found.linear.axes[i])

        def value(x, i=i, basis=basis):
            normal = basis[:, 0] + basis[:, 1:] @ x[3:]
            noise = sigma, 3 * sigma
            return negative_log_likelihood(x[:3], normal / np.linalg.norm(normal), poses[i], noise)

        start = np.concatenate([found.linear.position[i], [0, 0]])
        losses.append(value(start) - scipy.optimize.minimize(value, start, method="BFGS").fun)
    assert np.quantile(losses, 0.9) < 0.5  # half a unit is one standard deviation


@pytest.mark.parametrize("motion", ["paper", "reach"])
def test_a_cylinder_joint_is_known_as_well_as_the_noise_allows(motion):
    """Where it turns and slides at the same time, the axis of the rotations tells where the line is."""
    sigma, ratio = 1e-4, 5.0

    def one(key):
        errors = PoseErrors(sigma=sigma, rotation_ratio=ratio)
        return random_motion("C", key, samples=SAMPLES, dt=DT, excitation=motion, errors=errors)

    made = jax.vmap(one)(jax.random.split(jax.random.key(3), WINDOWS))
    poses, exact = np.asarray(made.poses), np.asarray(made.exact_poses)
    found = rf.identify(poses, dt=DT)
    # all types say the same; those whose path is summed up have more noise
    types = {rf.LinearType.GB, rf.LinearType.BG}
    assert np.mean([rf.LinearType(code) in types for code in np.asarray(found.linear.type_code)]) > 0.9
    bound = cramer_rao(made.truth, made.exact_poses, sigma, ratio)
    told = Told(*np.ones((2, WINDOWS), dtype=bool))
    scored = scores(found, Windows("C", made.truth, poses, exact, DT, bound, told))
    for name in ("angular", "linear", "position"):
        assert np.nanmedian(scored.errors[name] / scored.bounds[name]) < 1.15, name
