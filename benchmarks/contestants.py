"""Other solvers for the six problems of a window, all on the same moments."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import reframe_jax as rf
from benchmarks.dual_annealing import DT, anneal, six_moments
from benchmarks.timing import in_chunks, timed, timed_call
from reframe_jax.constraints.types import POSITION_BODIES, AngularType
from reframe_jax.objectives.velocity import FrameObjective
from reframe_jax.solvers import Box

TURN = np.pi
GENERAL = rf.BasinHopping(rf.FrameSteps(10), restarts=8, hops=3, polish=2)

Solved = tuple[np.ndarray, np.ndarray, float, float]
"""Norms (N, 6), linear positions (N, 4, 3) in m, run time in s, and compile time in s."""


def moments_about_centre(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angular and linear moments with windows first, and the reference point of positions in the ground."""
    centre = poses[:, :, :3, 3].mean(axis=1)
    centred = np.array(poses)
    centred[:, :, :3, 3] -= centre[:, None]
    angular, linear = in_chunks(_moments_of_chunk, centred)
    return angular, linear, centre


@jax.jit
def _moments_of_chunk(poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    angular, linear = six_moments(poses, DT)
    return jnp.moveaxis(angular, 2, 0), jnp.moveaxis(linear, 2, 0)


def shift_positions(positions: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Convert positions (N, 4, 3) to the convention of ``identify``: relative to the ground's origin."""
    in_ground = POSITION_BODIES[:, None] == AngularType.G
    return positions + np.where(in_ground, centre[:, None], 0)


def general_search(poses: np.ndarray) -> Solved:
    """Basin hopping over (rotation, position)."""
    angular, linear, centre = moments_about_centre(poses)
    turn, key = jnp.full(3, TURN), jax.random.key(0)
    box = Box(jnp.concatenate([-turn, -jnp.ones(3)]), jnp.concatenate([turn, jnp.ones(3)]))

    def of_chunk(angular: jax.Array, linear: jax.Array) -> tuple[jax.Array, jax.Array]:
        angular, linear = (jnp.moveaxis(moments, 0, 2) for moments in (angular, linear))
        turned = GENERAL.minimise(FrameObjective(angular), Box(-turn, turn), key)
        placed = GENERAL.minimise(FrameObjective(linear), box, key)
        return jnp.concatenate([turned.value, placed.value], axis=-1), jnp.moveaxis(placed.x[3:], 0, -1)

    run = jax.jit(of_chunk)
    (values, positions), seconds, compiling = timed(lambda: in_chunks(run, angular, linear), 1)
    return np.exp(values), shift_positions(positions, centre), seconds, compiling


@jax.jit
def _value_and_gradient(moments: jax.Array | np.ndarray, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.value_and_grad(lambda x: FrameObjective(jnp.asarray(moments)).value(x))(x)


def annealing(poses: np.ndarray, seeds: np.ndarray) -> Solved:
    """SciPy's dual annealing with the settings of the paper."""
    runs = [anneal(window, seed=int(seed), gradient=False) for window, seed in zip(poses, seeds, strict=True)]
    norms, positions, seconds = zip(*runs, strict=True)
    return np.stack(norms), np.stack(positions), sum(seconds), 0.0


def lbfgs(poses: np.ndarray, starts: int) -> Solved:
    """SciPy's L-BFGS-B from random starts, on the CPU to avoid transfers to an accelerator."""
    angular, linear, centre = moments_about_centre(poses)
    with jax.default_device(jax.devices("cpu")[0]):
        return _lbfgs(angular, linear, centre, starts)


def _lbfgs(angular: np.ndarray, linear: np.ndarray, centre: np.ndarray, starts: int) -> Solved:
    rng = np.random.default_rng(0)
    norms, positions = np.full((len(centre), 6), np.inf), np.zeros((len(centre), 4, 3))
    begin = time.perf_counter()
    for moments, dim in ((angular[0, ..., 0], 3), (linear[0, ..., 0], 6)):
        _value_and_gradient(moments, np.full(dim, 0.1))
    compiling = time.perf_counter() - begin
    begin = time.perf_counter()
    for i in range(len(centre)):
        for t in range(6):
            moments, dim = (angular[i, ..., t], 3) if t < 2 else (linear[i, ..., t - 2], 6)
            bounds = [(-TURN, TURN)] * 3 + [(-1.0, 1.0)] * (dim - 3)

            def objective(x: np.ndarray, moments: np.ndarray = moments) -> tuple[float, np.ndarray]:
                value, gradient = _value_and_gradient(moments, x)
                return float(value), np.asarray(gradient)

            low, high = np.array(bounds).T
            for start in rng.uniform(low, high, size=(starts, dim)):
                result = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds)
                if np.exp(result.fun) < norms[i, t]:
                    norms[i, t] = np.exp(result.fun)
                    if dim == 6:
                        positions[i, t - 2] = result.x[3:]
    return norms, shift_positions(positions, centre), time.perf_counter() - begin, compiling


def cma_es(poses: np.ndarray, runs: int, generations: int) -> Solved:
    """CMA-ES of evosax on unit coordinates of the box."""
    from evosax.algorithms import CMA_ES

    angular, linear, centre = moments_about_centre(poses)

    def solve(moments: jax.Array, key: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
        strategy = CMA_ES(population_size=4 + 3 * len(scale), solution=jnp.zeros(len(scale)))
        params = strategy.default_params.replace(std_init=jnp.asarray(0.4))
        start_key, key = jax.random.split(key)
        start = jax.random.uniform(start_key, scale.shape, minval=-1.0, maxval=1.0)
        state = strategy.init(key, start, params)
        fitness = jax.vmap(lambda x: FrameObjective(moments).value(jnp.clip(x, -1, 1) * scale))

        def generation(state: Any, key: jax.Array) -> tuple[Any, None]:
            ask, tell = jax.random.split(key)
            population, state = strategy.ask(ask, state, params)
            # points outside the box have a penalty equal to their distance from the box
            outside = jnp.sum(jnp.abs(population - jnp.clip(population, -1, 1)), axis=-1)
            state, _ = strategy.tell(tell, population, fitness(population) + outside, state, params)
            return state, None

        state, _ = jax.lax.scan(generation, state, jax.random.split(key, generations))
        best = jnp.clip(state.best_solution, -1, 1)
        return FrameObjective(moments).value(best * scale), best * scale

    def all_problems(angular: jax.Array, linear: jax.Array) -> tuple[jax.Array, jax.Array]:
        keys = jax.random.split(jax.random.key(0), runs)
        scales = jnp.full(3, TURN), jnp.concatenate([jnp.full(3, TURN), jnp.ones(3)])

        def best(moments: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
            values, x = jax.vmap(lambda key: solve(moments, key, scale))(keys)
            winner = jnp.argmin(values)
            return values[winner], x[winner]

        def over(moments: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
            problems = jnp.moveaxis(moments, 3, 1)
            return jax.vmap(jax.vmap(lambda m: best(m, scale)))(problems)

        turned, _ = over(angular, scales[0])
        values, x = over(linear, scales[1])
        return jnp.concatenate([turned, values], axis=-1), x[..., 3:]

    run = jax.jit(all_problems)
    (values, x), seconds, compiling = timed_call(run, angular, linear)
    return np.exp(np.asarray(values)), shift_positions(np.asarray(x), centre), seconds, compiling
