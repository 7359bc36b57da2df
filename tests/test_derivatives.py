"""Derivatives of what ``identify`` returns, against finite differences of the search itself."""

import copy
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.compilation import compiler_options
from reframe_jax.geometry import transforms
from reframe_jax.geometry.rotations import rotation_exp
from reframe_jax.identification.entry import default_solver
from reframe_jax.simulation import synthetic
from reframe_jax.simulation.motions import PoseErrors, disturb
from reframe_jax.simulation.sequences import simulate_sequence

# polished until the finite differences of the search itself are exact enough to compare with
SOLVER = rf.BasinHopping(rf.ValleySteps(8), restarts=4, hops=3, polish=6)


compiled = functools.partial(jax.jit, compiler_options=compiler_options())


def perturbed(poses, tangent):
    """Poses moved along body-fixed tangents (K+1, 6)."""
    return poses @ transforms.pose_exp(tangent)


def outputs(poses, linear_type, angular_type):
    """All determined numbers of the frames of fixed types, flat."""
    found = rf.identify(poses, dt=0.1, solver=SOLVER)
    linear, angular = found.candidates.linear, found.candidates.angular
    return {
        "norms": jnp.concatenate([angular.norm, linear.norm[linear_type][None]]),
        "rms": jnp.concatenate([angular.rms[angular_type], linear.rms[linear_type]]),
        "position": linear.position[linear_type],
        "pitch": jnp.nan_to_num(found.pitch),
        "free": linear.free_position[linear_type],
        "axes": jnp.concatenate(
            [
                odd_axis(rotation_exp(frames.rotvec[i]), frames.dof[i])
                for frames, i in ((linear, linear_type), (angular, angular_type))
            ]
        ),
    }


def odd_axis(axes, dof):
    """The unique axis, or zero where there is none."""
    count = jnp.sum(dof)
    unique = jnp.where(count == 1, axes[:, 2], axes[:, 0])
    return jnp.where((count == 1) | (count == 2), unique, 0.0)


def moved(step, poses, direction, linear_type, angular_type):
    return outputs(perturbed(poses, step * direction), linear_type, angular_type)


@compiled
def outputs_and_slopes(step, *arguments):
    """Both by one program."""
    return jax.jvp(lambda step: moved(step, *arguments), (step,), (jnp.ones(()),))


def along(step, *arguments):
    return outputs_and_slopes(step, *arguments)[0]


def slope_along(step, *arguments):
    return outputs_and_slopes(step, *arguments)[1]


def along_a_line(first, second):
    """Tangents (51, 6) that change evenly: the noise of poses moved along them stays the same."""
    return jnp.asarray(np.linspace(-1, 1, 51)[:, None] * first + second)


@pytest.mark.parametrize("label", [*rf.CONSTRAINTS, "screw"])
def test_derivatives_match_finite_differences(label):
    truth = rf.ConstraintFrame.named(label)
    poses = synthetic.simulate(label, jax.random.key(3), noise=3e-4).poses
    linear_type, angular_type = int(truth.linear_type), int(truth.angular_type)
    direction = np.random.default_rng(1).normal(size=(51, 6))
    h = 1e-6
    arguments = (poses, jnp.asarray(direction), linear_type, angular_type)
    exact = slope_along(jnp.zeros(()), *arguments)
    forward, backward = (along(jnp.asarray(step, float), *arguments) for step in (h, -h))
    for name, angular in (("norms", slice(2)), ("rms", slice(3))):
        finite = np.asarray(forward[name] - backward[name])[angular] / (2 * h)
        scale = np.max(np.abs(finite)) + 1e-3
        np.testing.assert_allclose(exact[name][angular] / scale, finite / scale, atol=2e-3, err_msg=name)
    # the noise of positions and rotations counts as given: along a line it stays the same, but for a little
    # noise of the orientation, which the likeliest frame of F follows: short steps there, and elsewhere such
    # that what the search leaves of an unclear direction makes no difference
    h = 1e-6 if label == "F" else 1e-5
    direction = along_a_line(direction[0], direction[1])
    arguments = (poses, direction, linear_type, angular_type)
    exact = slope_along(jnp.zeros(()), *arguments)
    forward, backward = (along(jnp.asarray(step), *arguments) for step in (h, -h))
    determined = np.eye(3) - np.asarray(along(jnp.zeros(()), *arguments)["free"])
    for name in ("norms", "rms", "position", "axes", "pitch"):
        slope = np.asarray(exact[name])
        finite = np.asarray(forward[name] - backward[name]) / (2 * h)
        if name == "position":
            slope, finite = determined @ slope, determined @ finite
        scale = np.max(np.abs(finite)) + 1e-3
        np.testing.assert_allclose(np.asarray(slope) / scale, finite / scale, atol=2e-3, err_msg=name)


def test_between_boundaries_the_frame_of_a_segment_is_differentiable():
    truth = simulate_sequence(["A", "K"], jax.random.key(1), dt=0.1, durations=8.0)
    poses = np.asarray(disturb(truth.exact_poses, jax.random.key(0), PoseErrors(sigma=1e-4), 0.1))
    segment = rf.segment(poses, dt=0.1).segments[1]
    assert segment.name == "Pin-plane contact"
    own = jnp.asarray(poses[segment.stop - 51 : segment.stop])
    linear = segment.identification.linear
    types = int(linear.type_code), int(segment.identification.angular.type_code)
    direction = along_a_line(*np.random.default_rng(4).normal(size=(2, 6)))
    slope = slope_along(jnp.zeros(()), own, direction, *types)["position"]
    forward, backward = (
        along(jnp.asarray(step, float), own, direction, *types)["position"] for step in (1e-6, -1e-6)
    )
    np.testing.assert_allclose(slope, (forward - backward) / 2e-6, atol=2e-3 * np.max(np.abs(slope)))


def far_window():
    """Poses (51, 4, 4) of a pin 3 m from the origin of the body, and the truth: its search is widened."""
    truth = rf.ConstraintFrame.named("K", position=jnp.asarray([2.0, -1.0, 2.0]))
    return synthetic.simulate(truth, jax.random.key(3), noise=1e-4).poses, truth


def test_derivatives_of_a_widened_search_match_finite_differences():
    poses, truth = far_window()
    types = int(truth.linear_type), int(truth.angular_type)
    direction = along_a_line(*np.random.default_rng(1).normal(size=(2, 6)))
    zero, h = jnp.zeros(()), 1e-6
    found = along(zero, poses, direction, *types)
    np.testing.assert_allclose(found["position"], truth.position, atol=0.02)
    exact = slope_along(zero, poses, direction, *types)
    forward, backward = (along(zero + step, poses, direction, *types) for step in (h, -h))
    for name in ("norms", "rms", "position", "axes"):
        finite = np.asarray(forward[name] - backward[name]) / (2 * h)
        scale = np.max(np.abs(finite)) + 1e-3
        atol = 3e-3 if name == "axes" else 2e-3  # as above
        np.testing.assert_allclose(np.asarray(exact[name]) / scale, finite / scale, atol=atol, err_msg=name)


@compiled
def position_jacobians(windows):
    """Of three windows (3, 51, 4, 4) in reverse mode: (3, 3, 51, 4, 4)."""

    def position(poses):  # polished: two programs round differently, and must end at the same point
        return rf.identify(poses, dt=0.1, solver=SOLVER).linear.position

    return jax.vmap(jax.jacrev(position))(windows)


def test_reverse_mode_agrees_with_forward_mode_under_jit_and_vmap():
    truth = rf.ConstraintFrame.named("K")
    keys = jax.random.split(jax.random.key(0), 2)
    poses = jax.vmap(lambda key: synthetic.simulate(truth, key, noise=1e-4).poses)(keys)
    poses = jnp.concatenate([poses, far_window()[0][None]])
    jacobians = np.asarray(position_jacobians(poses))
    compare_with_forward_mode(poses, jacobians, [truth] * 3, rtol=1e-5)


def compare_with_forward_mode(windows, jacobians, truths, **tolerance):
    """Jacobians of positions, with forward mode by the program that is compared with finite differences."""
    assert np.all(np.isfinite(jacobians))
    directions = jnp.asarray(np.random.default_rng(2).normal(size=(len(windows), 51, 6)))
    zero = jnp.zeros(())
    for window, direction, jacobian, truth in zip(windows, directions, jacobians, truths, strict=True):
        _, change = jax.jvp(lambda step, w=window, d=direction: perturbed(w, step * d), (zero,), (zero + 1,))
        types = int(truth.linear_type), int(truth.angular_type)
        forward = slope_along(zero, window, direction, *types)["position"]
        reverse = np.einsum("ikab,kab->i", jacobian, change)
        np.testing.assert_allclose(reverse, forward, **tolerance)


def test_reverse_mode_agrees_with_forward_mode_without_noise():
    truths = [rf.ConstraintFrame.named(label) for label in "BKL"]
    poses = jnp.stack([synthetic.simulate(truth, jax.random.key(3)).poses for truth in truths])
    compare_with_forward_mode(poses, np.asarray(position_jacobians(poses)), truths, rtol=1e-5, atol=1e-9)


@compiled
def jacobians_of_sums(windows):
    """Of positions, norms and pitches of (N, 51, 4, 4), added up without NaN: (5, N, 51, 4, 4)."""

    def sums(windows):
        found = rf.identify(windows, dt=0.1)
        numbers = jnp.append(jnp.nansum(found.linear.position, axis=0), jnp.nansum(found.linear.norm))
        return jnp.append(numbers, jnp.nansum(found.pitch))

    return jax.jacrev(sums)(windows)


@pytest.fixture(scope="module")
def of_default_search():
    """Derivatives (5, 51, 4, 4) of windows by name, of one batch: windows do not depend on each other."""

    def simulated(label, **options):
        return synthetic.simulate(label, jax.random.key(0), **options).poses

    labels = [*rf.CONSTRAINTS, "screw"]
    windows = {label: simulated(label, noise=1e-4) for label in labels}
    exact = {label: simulated(label) for label in labels}
    windows |= {f"{label} without noise": poses for label, poses in exact.items()}
    slide, hinge, window = exact["B"], exact["K"], windows["K"]
    windows |= {
        "no rotation": slide.at[:, :3, :3].set(jnp.eye(3)),
        "no translation": hinge.at[:, :3, 3].set(0.0),
        "half at rest": hinge.at[:25].set(hinge[25]),
        "a slide half at rest": slide.at[:25].set(slide[25]),
    }
    windows |= {
        "not finite": window.at[3, 0, 3].set(jnp.nan),
        "not a pose": window.at[5, 0, 0].add(0.5),
        "no motion": jnp.tile(window[:1], (51, 1, 1)),
    }
    derivatives = np.asarray(jacobians_of_sums(jnp.stack(list(windows.values()))))
    return dict(zip(windows, np.moveaxis(derivatives, 1, 0), strict=True))


def test_what_is_free_contributes_nothing(of_default_search):
    np.testing.assert_allclose(of_default_search["B"][:3], 0, atol=1e-9)
    assert np.all(np.max(np.abs(of_default_search["K"][:4]), axis=(1, 2, 3)) > 1e-6)
    moving = {name for name, slopes in of_default_search.items() if np.any(slopes[4] != 0)}
    assert moving == {"screw", "screw without noise"}


def test_derivatives_are_finite_whatever_the_window(of_default_search):
    for name, derivatives in of_default_search.items():
        assert np.all(np.isfinite(derivatives)), name


@pytest.mark.parametrize("norm", [0.0, 1.0, -1.0])
def test_the_default_solver_is_static(norm):
    """The same object at every call, and an equal one has the same hash: programs are not compiled again."""
    solver = default_solver(norm)
    assert solver is default_solver(norm)
    twin = copy.deepcopy(solver)
    assert twin is not solver
    assert twin == solver
    assert hash(twin) == hash(solver)
