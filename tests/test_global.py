"""Evidence that the search is global."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import benchmarks.motions  # noqa: F401, adds the excitation "slow"
import reframe_jax as rf
from benchmarks.dual_annealing import six_moments
from reframe_jax.identification.paper import default_solver
from reframe_jax.objectives.velocity import PositionObjective
from reframe_jax.simulation import synthetic
from reframe_jax.solvers import Box, JointSearch

SEEDS = 6
NOISES = np.logspace(-6, -3, 4)


def simulated(label, noises=NOISES, seeds=SEEDS, excitation="exciting"):
    """Windows of one constraint over seeds and noise levels, about their centre, and the centres."""
    frame = rf.ConstraintFrame.named(label)
    keys = jax.random.split(jax.random.key(11), seeds * len(noises))
    tiled = jnp.tile(jnp.asarray(noises), seeds)
    simulate = jax.vmap(lambda k, s: synthetic.simulate(frame, k, noise=s, excitation=excitation).poses)
    poses = simulate(keys, tiled)  # not compiled as one: every constraint would be a program
    centre = jnp.mean(poses[..., :3, 3], axis=1)
    return poses.at[..., :3, 3].add(-centre[:, None]), centre


@pytest.fixture(scope="module")
def windows():
    return jnp.concatenate([simulated(label)[0] for label in rf.CONSTRAINTS])


@pytest.fixture(scope="module")
def problems(windows):
    """Linear moments (6, 10, windows, 4)."""
    return six_moments(windows, 0.1)[1]


CUBE = Box(-jnp.ones(3), jnp.ones(3))


def minimise(solver, objective, key):
    return solver.minimise(objective, CUBE, key)


short = jax.jit(minimise, static_argnums=0)
# reference searches run for longer than they compile, so LLVM optimises their programs
long = jax.jit(minimise, static_argnums=0, compiler_options={"xla_backend_optimization_level": 1})


def search(solver, objective, program=short, seed=0):
    """Value of every problem, (windows, 4)."""
    return program(solver, objective, jax.random.key(seed)).value


def test_the_searches_reach_the_best_of_64_long_searches(windows, problems):
    """That of ``identify`` and that of ``default_solver``."""
    many = rf.BasinHopping(rf.ValleySteps(40), restarts=64, hops=0, refine=rf.ValleySteps(40))
    best = search(many, PositionObjective(problems), long, seed=1)
    # with thresholds, the search is the same, and no constraint is fitted
    identified = rf.identify(windows, dt=0.1, scales=1, bounds=1.0, thresholds=rf.Thresholds())
    found = np.log(np.asarray(identified.linear.norms))
    hopping = np.asarray(search(default_solver(), PositionObjective(problems)))
    best = np.minimum(best, np.minimum(found, hopping))
    assert np.mean(found - best > 1e-3) <= 1e-2
    assert np.mean(hopping - best > 1e-3) <= 1e-3


def above_truth(label):
    """How far the search of slow motions ends above log J of the true origin, (96,)."""
    frame = rf.ConstraintFrame.named(label)
    poses, centre = simulated(label, np.logspace(-6, -5, 4), 24, "slow")
    kind = frame.linear_type
    linear = PositionObjective(six_moments(poses, 0.1)[1][..., int(kind)])
    origin = frame.position[None] - (centre if kind.position_body == rf.AngularType.G else 0 * centre)
    return np.asarray(search(default_solver(), linear) - linear.value(origin.T))


def test_slow_motion_is_mostly_explained_as_well_as_by_the_truth():
    """Its valleys are many and narrow: without rounds 21 % of these searches end above the truth, not 4 %."""
    assert np.mean(np.concatenate([above_truth(label) for label in "KL"]) > 1e-3) < 0.07


# the stillest axis alone (-inf) has many minima of nearly the same depth: which of them a search ends in
# depends on rounding, and so do the misses: 1 or 2 of the 96 problems here with jax 0.10, 4 with 0.11
LARGEST_MISS = 0.03 if jax.__version_info__ < (0, 11) else 0.06


@pytest.mark.parametrize(("exponent", "missed"), [(-np.inf, LARGEST_MISS), (-1.0, 1e-3), (1.0, 1e-3)])
def test_other_norms_reach_the_best_of_a_longer_search(problems, exponent, missed):
    some = PositionObjective(problems[:, :, ::12], exponent)
    joint = JointSearch(rf.BasinHopping(rf.FrameSteps(15), restarts=48, hops=4), refine=rf.ValleySteps(10))
    best = search(joint, some, long, seed=1)
    found = search(default_solver(exponent), some)
    best = jnp.minimum(best, found)
    assert np.mean(np.asarray(found - best) > 1e-3) <= missed


def test_origins_do_not_depend_on_the_other_windows_of_a_batch(windows):
    """Every origin stops when it has converged, however many steps the others take."""
    poses, options = np.asarray(windows[::9]), {"dt": 0.1, "scales": 1, "thresholds": rf.Thresholds()}
    together = rf.identify(poses, **options).candidates.linear.position
    singles = [rf.identify(np.tile(window, (9, 1, 1, 1)), **options) for window in poses]
    separate = np.stack([found.candidates.linear.position[0] for found in singles])
    np.testing.assert_allclose(together, separate, rtol=0, atol=1e-10)
