"""Windows identified with NumPy: the same results as those of compiled programs, and nothing compiled."""

import functools
import itertools
import threading

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import reframe_jax as rf
from reframe_jax import arrays
from reframe_jax.identification import programs, uncompiled
from reframe_jax.simulation.synthetic import simulate

DT = 0.1
NOISES = [1e-6, 1e-5, 1e-4, 1e-3]


def windows(label, **options):
    """(4, 51, 4, 4), of one constraint, from hardly any noise to much."""
    made = [simulate(label, jax.random.key(n), noise=s, dt=DT, **options) for n, s in enumerate(NOISES)]
    return np.stack([np.asarray(one.poses) for one in made])


def both(poses, **options):
    timing = {} if "times" in options else {"dt": options.pop("dt", DT)}
    return [rf.identify(poses, **timing, **options, compiled=compiled) for compiled in (False, True)]


def assert_same(found, expected, **tolerance):
    """Types of arrays, what is decided, and numbers that the window determines."""
    for (path, x), y in zip(jax.tree.leaves_with_path(found), jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        assert isinstance(x, jax.Array), name
        assert (x.dtype, x.shape) == (y.dtype, y.shape), name
        # rotation vectors of axes of which none is unique; restarts that end near the limit of agreement
        if "rotvec" not in name and "agreement" not in name:
            np.testing.assert_allclose(x, y, **tolerance, err_msg=name)
    np.testing.assert_array_equal(found.name, expected.name)


@pytest.mark.parametrize("label", rf.CONSTRAINTS)
def test_the_twelve_constraints(label):
    found, expected = both(windows(label))
    assert_same(found, expected, rtol=1e-5, atol=1e-6)
    determined = rf.CONSTRAINTS[label].angular_axis is not None
    if determined:
        np.testing.assert_allclose(found.angular.rotvec, expected.angular.rotvec, atol=1e-7)


@pytest.mark.parametrize(
    "options",
    [
        {"lag": 1},
        {"lag": 3},
        {"lag": 0.4},
        {"lag": 0.4, "dt": np.full((4, 50), [[0.05], [0.1], [0.1], [0.2]])},
        {"times": np.arange(51) * DT + 1.7e9, "bounds": (np.array([-1.0, -2, -3]), 4.0)},
        {"discretization": "left", "thresholds": rf.Thresholds()},
        {"norm": 1.0, "key": jax.random.key(5)},
    ],
    ids=lambda options: "-".join(options),
)
def test_every_option(options):
    found, expected = both(windows("L"), **options)
    assert_same(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("label", "AK")
def test_single_precision(label):
    found, expected = both(windows(label).astype(np.float32))
    assert found.linear.position.dtype == np.float32
    np.testing.assert_array_equal(found.name, expected.name)
    np.testing.assert_allclose(found.linear.norms, expected.linear.norms, rtol=1e-2)


def test_outliers_pauses_and_windows_that_fail():
    poses = np.repeat(windows("A")[2:3], 6, axis=0)
    poses[0, 20, :3, 3] += 0.3  # a jump
    poses[1, 10:30] = poses[1, 10]  # a pause
    poses[2, 5] = np.nan
    poses[3] = poses[3, 0]  # nothing moves
    poses[4, :, :3, :3] *= 1.1
    found, expected = both(poses)
    assert_same(found, expected, rtol=1e-5, atol=1e-6)
    assert not found.counted[0, 20]
    assert [rf.Status(int(code)).failed for code in found.status] == [False, False, True, True, True, False]


def test_a_screw_has_its_pitch():
    screw = simulate("C", jax.random.key(0), noise=1e-5, dt=DT, pitch=0.02).poses
    found, expected = both(np.asarray(screw))
    assert found.name == expected.name == "Screw joint"
    np.testing.assert_allclose(found.pitch, expected.pitch, rtol=1e-6)


def test_a_universal_joint_has_its_axes(rng):
    t = np.arange(101) * DT
    turns = 0.5 * np.sin(0.9 * t), 0.4 * np.sin(1.7 * t + 1)
    poses = np.tile(np.eye(4), (101, 1, 1))
    turn = Rotation.from_euler("XY", np.stack(turns, axis=1)) * Rotation.from_rotvec(
        3e-4 * rng.normal(size=(101, 3))
    )
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = turn.apply([0.1, 0.05, -0.08]) + 1e-4 * rng.normal(size=(101, 3))
    found, expected = both(poses)
    assert found.name == expected.name == "Universal joint"
    np.testing.assert_allclose(found.universal_axes, expected.universal_axes, atol=1e-7)


def test_a_batch_equals_its_windows():
    poses = np.concatenate([windows("K"), windows("H")] * 9)  # more than are computed at a time
    assert len(poses) > uncompiled._CHUNK
    found = rf.identify(poses.reshape(2, -1, *poses.shape[1:]), dt=DT, compiled=False)
    assert found.linear.position.shape == (2, 36, 3)
    for row, column in ((0, 2), (1, 35)):
        alone = rf.identify(poses[36 * row + column], dt=DT, compiled=False)
        assert alone.name == found[row, column].name
        np.testing.assert_allclose(alone.linear.position, found.linear.position[row, column], atol=1e-7)


def test_the_first_calls_compile_no_search(monkeypatch):
    """What is compiled for them are the random numbers of the search."""
    for program in ("reduce_one", "solve_one", "identify_compiled", "_reduce_chunks", "_solve_chunks"):
        monkeypatch.setattr(programs, program, None)
    poses = windows("B")
    assert rf.identify(poses[1], dt=DT).name == "Prismatic joint"
    assert set(rf.identify(poses, dt=DT).name) == {"Prismatic joint"}


def test_later_calls_and_large_batches_are_compiled(monkeypatch):
    monkeypatch.setattr(uncompiled, "FIRST_CALLS", 2)
    kind = "auto", rf.default_solver()
    window, batch = np.zeros((5, 4, 4)), np.zeros((65, 5, 4, 4))
    assert uncompiled.compile_windows(None, batch, *kind)
    assert [uncompiled.compile_windows(None, window, *kind) for _ in range(4)] == [False, False, True, True]
    assert not uncompiled.compile_windows(None, window, "single", kind[1])  # another program
    assert uncompiled.compile_windows(None, window, "auto", rf.default_solver(-1))
    there = jax.device_put(window, jax.devices()[0])
    assert uncompiled.compile_windows(None, there, "given", kind[1])


def test_transformations_are_those_of_jax():
    """NumPy would refuse the traced poses."""
    poses = jnp.zeros((51, 4, 4))
    identify = functools.partial(rf.identify, dt=DT, compiled=False)
    assert jax.eval_shape(identify, poses).linear.position.shape == (3,)


@pytest.mark.parametrize("solver", [rf.BasinHopping(rf.NewtonSteps(4)), rf.default_solver(-1)])
def test_solvers_that_need_derivatives_are_refused(solver):
    with pytest.raises(ValueError, match="NumPy runs BasinHopping with ValleySteps only"):
        rf.identify(windows("B"), dt=DT, solver=solver, compiled=False)


@pytest.mark.parametrize(
    ("label", "how"),
    [
        ("A", "white"),
        *itertools.product("AK", ["measured", "bootstrap", "excitation"]),
        *itertools.product("CHL", ["measured"]),
    ],
)
def test_how_sure(label, how):
    poses = windows(label)[1:]
    found = rf.identify(poses, dt=DT)

    def compute(compiled):
        if how == "excitation":
            return rf.excitation(found, poses, dt=DT, compiled=compiled)
        options = {"method": how} if how == "bootstrap" else {"errors": how}
        return rf.covariance(found, poses, dt=DT, **options, compiled=compiled)

    quick, slow = compute(False), compute(True)
    for (path, x), y in zip(jax.tree.leaves_with_path(quick), jax.tree.leaves(slow), strict=True):
        name = jax.tree_util.keystr(path)
        assert (x.dtype, x.shape) == (y.dtype, y.shape), name
        largest = float(np.nanmax(np.abs(np.asarray(y, float))))
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-8 * largest, err_msg=name)


def test_a_choice_that_is_none_is_refused():
    with pytest.raises(ValueError, match="compiled must be True, False or None, not 'no'"):
        rf.identify(windows("B"), dt=DT, compiled="no")


def test_a_stream_may_use_numpy():
    poses = windows("A")[1]
    stream = rf.OnlineIdentifier(len(poses), dt=DT, compiled=False)
    found = [stream.push(pose) for pose in poses]
    assert found[:-1] == [None] * (len(poses) - 1)
    assert found[-1].name == "Revolute joint"


numbers = st.lists(st.floats(-40, 40), min_size=4, max_size=24).map(np.array)


@hypothesis.settings(max_examples=12)
@given(numbers)
def test_functions_are_those_of_jax(x):
    x = x[: len(x) // 2 * 2].reshape(2, -1)
    gaps = np.where(x > 20, np.nan, x)

    def compute():
        nn, jnp, lax = arrays.nn, arrays.jnp, arrays.lax
        yield nn.softmax(x, axis=1)
        yield nn.sigmoid(x)
        yield nn.log_sigmoid(x)
        yield nn.logsumexp(x, axis=0)
        yield arrays.norm.cdf(x)
        yield jnp.nanmedian(gaps, axis=1)
        yield jnp.nanmedian(gaps)
        yield jnp.matmul(x, x.T, precision=lax.Precision.HIGHEST)
        yield lax.cummax(x, axis=1)
        yield lax.cummin(x, axis=1, reverse=True)
        yield lax.reduce_precision(x, 8, 23)
        yield lax.stop_gradient(x)
        yield lax.cond(x[0, 0] > 0, lambda a, b: a + b, lambda a, b: a - b, x, x)
        yield lax.fori_loop(1, 4, lambda i, value: value * i, x)
        yield lax.while_loop(lambda value: value[0, 0] < 50, lambda value: value + 30, x)
        yield from lax.scan(lambda carry, row: (carry + row, carry), x[0], x)
        yield lax.scan(lambda carry, _: (carry + 1, None), x, length=3)[0]
        yield arrays.vmap(lambda a, b: a * b, in_axes=(0, None), out_axes=1)(x, x[0])
        yield arrays.put(jnp.asarray(x), (0, slice(1, None)), 7.0)
        yield arrays.linalg.solve_triangular(np.array([[2.0, 0], [1, 3]]), x, lower=True)
        yield arrays.linalg.solve_triangular(np.array([[2.0, 0], [1, 3]]), x, lower=True, trans=1)
        yield arrays.random.normal(jax.random.key(3), (2, 5))
        yield arrays.random.uniform(jax.random.key(3), (2, 5))

    expected = list(compute())
    with arrays.with_numpy():
        found = list(compute())
    assert not arrays.using_numpy()
    for number, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert isinstance(one, np.ndarray), number
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-15, err_msg=str(number))


def test_numpy_keeps_single_precision_in_densities():
    x = np.linspace(-30, 30, 7, dtype=np.float32)
    with arrays.with_numpy():
        for function in (arrays.norm.cdf, arrays.nn.sigmoid, arrays.nn.log_sigmoid):
            assert function(x).dtype == np.float32


def test_matrices_that_are_refused_become_nan():
    """NumPy would raise an error for all of them."""
    bad = np.stack([np.eye(2), np.full((2, 2), np.nan), -np.eye(2), [[1.0, 2], [2, 1]]])

    def roots():
        cholesky = arrays.jnp.linalg.cholesky
        return np.tril(cholesky(bad)), np.tril(cholesky(bad[2]))

    def axes():
        return arrays.jnp.linalg.eigh(bad)

    expected = [*roots(), *axes()]
    singular = np.array([np.eye(2), [[1.0, 0], [1, 0]]])
    with arrays.with_numpy():
        found = [*roots(), *axes()]
        solved = arrays.linalg.solve_triangular(singular, np.ones((2, 2, 1)), lower=True)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(np.isnan(one), np.isnan(other))
        kept = ~np.isnan(one)
        np.testing.assert_allclose(np.abs(one[kept]), np.abs(np.asarray(other)[kept]), atol=1e-12)
    assert np.all(solved[0] == 1)
    assert np.all(np.isnan(solved[1]))


def test_other_precisions_are_not_pretended():
    with arrays.with_numpy(), pytest.raises(NotImplementedError, match="float32 only"):
        arrays.lax.reduce_precision(np.ones(2), 5, 10)


def test_put_leaves_the_array_as_it_was():
    array = np.zeros(3)
    with arrays.with_numpy():
        np.testing.assert_array_equal(arrays.put(array, 1, 5.0), [0, 5, 0])
    np.testing.assert_array_equal(array, 0)


def test_other_threads_compute_with_jax():
    seen = []
    with arrays.with_numpy():
        thread = threading.Thread(target=lambda: seen.append(type(arrays.jnp.ones(2))))
        thread.start()
        thread.join()
        assert isinstance(arrays.jnp.ones(2), np.ndarray)
    assert issubclass(seen[0], jax.Array)


def test_a_rule_of_derivatives_is_skipped_with_numpy():
    @arrays.custom_jvp
    def double(x):
        return 2 * x

    double.defjvp(lambda primals, tangents: (double(*primals), 7 * tangents[0]))
    assert jax.grad(double)(1.0) == 7
    with arrays.with_numpy():
        assert isinstance(double(np.ones(2)), np.ndarray)


def test_a_gpu_leaves_numpy_alone(monkeypatch):
    """Kernels for a GPU are for arrays that lie there."""
    expected = rf.identify(windows("H"), dt=DT, compiled=False)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = rf.identify(windows("H"), dt=DT, compiled=False)
    np.testing.assert_array_equal(found.linear.position, expected.linear.position)
