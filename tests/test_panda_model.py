"""The arm against implementations of its own: Denavit-Hartenberg, Newton-Euler, and C MuJoCo."""

import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reframe_jax.geometry.small import solve_positive
from reframe_jax.simulation import arm as panda
from reframe_jax.simulation.arm import model as models

ARMS = list(panda.ROBOTS.values())


def configurations(rng: np.random.Generator, arm: panda.Arm, count: int) -> np.ndarray:
    lower, upper = arm.limits
    return rng.uniform(lower, upper, (count, 7))


def denavit_hartenberg(joints: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of the TCP from the manufacturer's parameters, in Craig's convention."""
    a = [0, 0, 0, 0.0825, -0.0825, 0, 0.088, 0]
    d = [0.333, 0, 0.316, 0, 0.384, 0, 0, 0.107 + 0.1034]
    alpha = np.array([0, -1, 1, 1, -1, 1, 1, 0]) * np.pi / 2
    pose = np.eye(4)
    for i, theta in enumerate([*joints, -np.pi / 4]):
        ca, sa, ct, st = np.cos(alpha[i]), np.sin(alpha[i]), np.cos(theta), np.sin(theta)
        pose = pose @ [
            [ct, -st, 0, a[i]],
            [st * ca, ct * ca, -sa, -d[i] * sa],
            [st * sa, ct * sa, ca, d[i] * ca],
            [0, 0, 0, 1],
        ]
    return pose


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z)."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def newton_euler(arm: panda.Arm, q: np.ndarray, v: np.ndarray, acc: np.ndarray) -> np.ndarray:
    """Joint torques without gravity by the recursive algorithm in link frames (Luh, Walker, Paul 1980)."""
    model = arm.model
    z = np.array([0, 0, 1.0])
    w, dw, a = np.zeros(3), np.zeros(3), np.zeros(3)
    outward = []
    for i in range(8):
        turn = rotation_of(model.body_quat[i + 1])
        angle, rate, speedup = (q[i], v[i], acc[i]) if i < 7 else (0.0, 0.0, 0.0)
        c, s = np.cos(angle), np.sin(angle)
        turn = turn @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        p = model.body_pos[i + 1]
        a = turn.T @ (a + np.cross(dw, p) + np.cross(w, np.cross(w, p)))
        w_parent = turn.T @ w
        dw = turn.T @ dw + np.cross(w_parent, z * rate) + z * speedup
        w = w_parent + z * rate
        centre, principal = model.body_ipos[i + 1], rotation_of(model.body_iquat[i + 1])
        inertia = principal @ np.diag(model.body_inertia[i + 1]) @ principal.T
        force = model.body_mass[i + 1] * (a + np.cross(dw, centre) + np.cross(w, np.cross(w, centre)))
        moment = inertia @ dw + np.cross(w, inertia @ w) + np.cross(centre, force)
        outward.append((turn, p, force, moment))
    force, moment, torques = np.zeros(3), np.zeros(3), []
    for i in reversed(range(8)):
        turn, p, own_force, own_moment = outward[i]
        force, moment = force + own_force, moment + own_moment
        torques.append(moment[2])
        force = turn @ force
        moment = turn @ moment + np.cross(p, force)
    return np.array(torques[::-1][:7]) + model.dof_armature * acc


def test_ready_pose() -> None:
    ready = jnp.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    _, position = panda.forward_kinematics(ready)
    np.testing.assert_allclose(position, [0.3069, 0, 0.4869], atol=1e-4)


def test_forward_kinematics_is_that_of_the_manufacturer(rng: np.random.Generator) -> None:
    joints = configurations(rng, panda.PANDA, 20)
    rotation, position = panda.forward_kinematics(jnp.asarray(joints))
    poses = np.array([denavit_hartenberg(q) for q in joints])
    np.testing.assert_allclose(position, poses[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation, poses[:, :3, :3], atol=1e-12)


def test_home_has_room() -> None:
    for arm in ARMS:
        lower, upper = arm.limits
        assert np.all(np.array(arm.home) - lower > 0.5)
        assert np.all(upper - np.array(arm.home) > 0.5)


@pytest.fixture(scope="module", params=ARMS, ids=lambda arm: arm.name)
def motions(request: pytest.FixtureRequest) -> tuple[panda.Arm, np.ndarray, np.ndarray, panda.Motion]:
    """Motions of a few states: one compilation for each robot."""
    rng = np.random.default_rng(7)
    arm = request.param
    q, v = configurations(rng, arm, 6), rng.normal(size=(6, 7))
    compute = jax.jit(jax.vmap(lambda q, v: panda.arm_motion(q, v, arm)))
    return arm, q, v, compute(jnp.asarray(q), jnp.asarray(v))


def test_motion_is_that_of_c_mujoco(motions: tuple) -> None:
    arm, joints, velocities, motion = motions
    model = mujoco.MjModel.from_xml_string(arm.xml)
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    for i, (q, v) in enumerate(zip(joints, velocities, strict=True)):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        linear, angular, mass = np.zeros((3, 7)), np.zeros((3, 7)), np.zeros((7, 7))
        mujoco.mj_jacSite(model, data, linear, angular, model.site("tcp").id)
        for column, unit in enumerate(np.eye(7)):
            mujoco.mj_mulM(model, data, mass[column], unit)
        np.testing.assert_allclose(motion.position[i], data.site("tcp").xpos, atol=1e-12)
        np.testing.assert_allclose(motion.rotation[i].ravel(), data.site("tcp").xmat, atol=1e-12)
        np.testing.assert_allclose(motion.jacobian[i], np.vstack([angular, linear]), atol=1e-12)
        np.testing.assert_allclose(motion.mass[i], mass, atol=1e-10)
        np.testing.assert_allclose(motion.bias[i], data.qfrc_bias, atol=1e-10)
        twist = jax.tree.map(lambda leaf, i=i: leaf[i], motion).twist
        np.testing.assert_allclose(twist, np.concatenate([angular @ v, linear @ v]), atol=1e-12)


def test_inverse_dynamics_is_newton_euler(motions: tuple, rng: np.random.Generator) -> None:
    arm, joints, velocities, motion = motions
    for i, (q, v) in enumerate(zip(joints, velocities, strict=True)):
        a = rng.normal(size=7)
        torque = motion.mass[i] @ a + motion.bias[i]
        np.testing.assert_allclose(torque, newton_euler(arm, q, v, a), atol=1e-9)


def test_jacobian_is_the_derivative_of_forward_kinematics(motions: tuple) -> None:
    arm, joints, _, motion = motions
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda q: panda.forward_kinematics(q, arm)[1])))(jnp.asarray(joints))
    np.testing.assert_allclose(motion.jacobian[:, 3:], slopes, atol=1e-12)


def test_library_does_not_import_mujoco() -> None:
    code = "import sys, reframe_jax; raise SystemExit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(jax.__version_info__ >= (0, 11), reason="its XLA does not repeat the chain (1.3 times)")
def test_the_fence_is_still_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drop ``fence_levels`` with the support of jax 0.10; without the private scan, results are the same."""

    def run() -> tuple[jax.Array, float]:
        def advance(state: tuple, _: None) -> tuple:
            q, v = state
            motion = panda.arm_motion(q, v)
            v = v - 0.01 * solve_positive(motion.mass, motion.bias + v)
            return (q + 0.01 * v, v), motion.position

        q = jnp.asarray(panda.PANDA.home)
        roll = jax.jit(lambda q: jax.lax.scan(advance, (q, 0.1 * q), None, length=3)[1]).lower(q)
        compiled = roll.compile(compiler_options={"xla_cpu_use_fusion_emitters": True})
        compiled(q).block_until_ready()
        start = time.perf_counter()
        path = compiled(q).block_until_ready()
        return path, time.perf_counter() - start

    path, fenced = run()
    monkeypatch.setattr(models, "mjx_scan", None)
    unfenced_path, unfenced = run()
    np.testing.assert_allclose(unfenced_path, path, atol=1e-12)
    assert unfenced > 3 * fenced, f"{unfenced:.4f} s without the fence, {fenced:.4f} s with it"
