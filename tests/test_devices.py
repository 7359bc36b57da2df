"""Windows spread over devices. In a process of its own: devices are fixed when JAX starts."""

import subprocess
import sys
import textwrap

SCRIPT = """
    import gc, os
    gc.disable()  # tracing makes millions of objects, and next to no garbage
    os.environ["JAX_PLATFORMS"] = "cpu"
    import jax, numpy as np
    import jax.numpy as jnp
    jax.config.update("jax_num_cpu_devices", 3)
    jax.config.update("jax_enable_x64", True)
    import functools
    import reframe_jax as rf
    from reframe_jax.simulation import synthetic
    from reframe_jax.solvers import Solution

    keys = jax.random.split(jax.random.key(0), 12)
    poses = np.asarray(jax.vmap(lambda k: synthetic.simulate("K", k, noise=1e-4, duration=1.0).poses)(keys))

    class OneStep:
        # one step down from the middle of the box: a search would take long to compile

        def minimise(self, objective, box, key):
            middle = jnp.zeros((3, *objective.moments.shape[2:]))
            slope = jax.grad(lambda x: jnp.sum(objective.value(x)))(middle)
            x = box.clip(-0.1 * slope)
            value = objective.value(x)
            return Solution(x, value, jnp.ones_like(value))

    # with thresholds, the table is not compared: a third of the program
    identify = functools.partial(rf.identify, solver=OneStep())
    by_thresholds = functools.partial(identify, thresholds=rf.Thresholds())
    # each combination below compiles a program: equal times on one device; own times on three, in more than
    # one piece on a device, the last of them not full, with rows of several windows
    steps = np.linspace(0.1, 0.2, 12)[:, None] * np.ones((1, poses.shape[1] - 1))
    cases = (1, by_thresholds, 0.1, 1, (12,)), (3, identify, steps, 77, (84, 11))
    for count, find, dt, copies, rows in cases:
        mesh = jax.make_mesh((count,), ("windows",), devices=jax.devices()[:count])
        sharding = jax.NamedSharding(mesh, jax.P("windows"))
        many = np.tile(poses, (copies, 1, 1, 1)).reshape(*rows, *poses.shape[1:])
        own = dt if count == 1 else np.tile(dt, (copies, 1)).reshape(*rows, -1)
        found, alone = find(jax.device_put(many, sharding), dt=own), find(poses, dt=dt)
        assert len(np.unique(np.round(alone.linear.norm, 9))) == 12
        assert found.linear.norm.shape == rows
        assert len(found.linear.norm.sharding.device_set) == count
        norms, positions = found.linear.norm.ravel(), found.linear.position.reshape(-1, 3)
        np.testing.assert_allclose(norms, np.tile(alone.linear.norm, copies), rtol=1e-9)
        np.testing.assert_allclose(positions, np.tile(alone.linear.position, (copies, 1)), atol=1e-6)
    np.testing.assert_array_equal(found.name.ravel(), np.tile(alone.name, copies))
    expected = by_thresholds(poses, dt=0.1)
    # on all devices, and a sharding that says so for every axis, which uses the same program
    for spec in (jax.P(), jax.P(None, None, None, None)):
        everywhere = by_thresholds(jax.device_put(poses, jax.NamedSharding(mesh, spec)), dt=0.1)
        np.testing.assert_allclose(everywhere.linear.norm, expected.linear.norm, rtol=1e-9)
    # on another device than the first
    second = jax.devices()[1]
    there = by_thresholds(jax.device_put(poses[3], second), dt=0.1)
    assert there.linear.norm.devices() == {second}
    np.testing.assert_allclose(there.linear.norm, expected.linear.norm[3], rtol=1e-9)
"""


def test_results_do_not_depend_on_the_number_of_devices():
    subprocess.run([sys.executable, "-c", textwrap.dedent(SCRIPT)], check=True)
