"""The simulated hand that guides the arm, its excitations, and the compiled programs of a demonstration.

The hand pulls the tool towards a moving pose that obeys the constraint, through a spring and a damper, with a
small misalignment and a tremor. All inputs are smooth functions of time, so a demonstration does not depend
on the time step of its simulation.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from reframe_jax.constraints.frame import Frame, ground_twist, locate, twist_map
from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.geometry.small import solve_positive, times
from reframe_jax.simulation.arm.imperfections import Imperfections, by_axis, compliance_of
from reframe_jax.simulation.arm.model import Arm, Motion, arm_motion, forward_kinematics
from reframe_jax.simulation.arm.rollout import Drive, Steps, Track, hold, integrate
from reframe_jax.simulation.motions import round_to
from reframe_jax.simulation.synthetic import Excitation

_RATES = ((1.4, 4.4), (2.4, 5.4), (3.4, 6.4))  # rad/s, by axis; 5 s distinguish these rates
_LINEAR_RATE = 1.13  # ratio of linear to angular rates
_TURNING = 0.4  # rad/s, amplitude of each sine
_MOVING = 0.1  # m/s, amplitude of each sine
_ONE_TURN = ((1.4, 4.4), (0.48, 0.48))  # rad/s, rates and amplitudes for a single free rotation
_BRISK_TURN = ((1.6, 2.5), (0.9, 0.4))
_DRAWS, _EVEN_OVER = 4, 5.0  # number of phase draws, and the time (s) over which the most even draw is chosen
_EASE = 0.6  # s, duration of the start of a motion
_STIFFNESS = (20.0, 400.0)  # N m/rad and N/m, of the spring between hand and tool
_DAMPING = (2.0, 40.0)  # N m s/rad and N s/m
_MISALIGNMENT = (0.02, 0.003)  # rad and m, standard deviation per component of the constant error of the grip
_TREMOR = (0.4, 1.5)  # N m and N, RMS of each component of the shaking moment and force
_TREMOR_RATES = (7.0, 17.0, 31.0, 47.0)  # rad/s, rates of corrections and of shaking of the hand


def _ease(t: jax.Array) -> jax.Array:
    """Smooth transition from 0 to 1 at the start of the motion."""
    s = jnp.clip(t / _EASE, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _sines(
    key: jax.Array, free: jax.Array, one_rates: tuple[float, float], one_turning: tuple[float, float]
) -> Excitation:
    """Two sines along every free axis; ``one_rates`` and ``one_turning``, rad/s, if one rotation is free."""
    draws = jax.random.uniform(key, (_DRAWS, 2, 3, 2), free.dtype, maxval=2 * jnp.pi)
    free = free.reshape(2, 3)
    # the first free axis, angular or linear, has the lowest rate and the largest displacement
    order = jnp.cumsum(free, axis=1).astype(jnp.int32) - 1
    rates = jnp.asarray(_RATES, dtype=draws.dtype)[jnp.maximum(order, 0)]
    one = jnp.sum(free[0]) == 1
    turning_rates = jnp.where(one, jnp.asarray(one_rates, dtype=draws.dtype)[None], rates[0])
    rates = jnp.stack([turning_rates, _LINEAR_RATE * rates[1]])
    turning = jnp.where(one, jnp.asarray(one_turning, dtype=draws.dtype), _TURNING)
    speeds = jnp.stack([turning, jnp.full_like(turning, _MOVING)])[:, None]
    phases = _most_even_phases(draws, rates, free)

    def displacement(t: jax.Array) -> jax.Array:
        return _ease(t) * jnp.sum(speeds * jnp.sin(rates * t + phases) / rates, axis=-1)

    def velocity(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        angular, linear = jax.jvp(displacement, (t,), (jnp.ones_like(t),))[1]
        return angular, linear

    return velocity


def _most_even_phases(draws: jax.Array, rates: jax.Array, free: jax.Array) -> jax.Array:
    """Choose the phases, out of draws (n, 2, 3, 2), whose direction of least motion moves most."""
    # with equal phases along two free axes, a direction between them would be at rest and seem constrained
    t = jnp.linspace(0, _EVEN_OVER, 64, dtype=draws.dtype)
    angles = rates[None, ..., None] * t[None, None, None, None] + draws[..., None]
    velocity = jnp.sum(jnp.cos(angles), axis=-2) * free[None, :, :, None]
    covariance = jnp.mean(velocity[:, :, :, None] * velocity[:, :, None], axis=-1)
    still = (1 - free)[:, :, None] * jnp.eye(3, dtype=free.dtype)[None]  # constrained axes do not count
    best = jnp.argmax(jnp.linalg.eigvalsh(covariance + still[None])[..., 0], axis=0)
    return jnp.take_along_axis(draws, best[None, :, None, None], axis=0)[0]


EXCITATIONS: dict[str, Callable[[jax.Array, jax.Array], Excitation]] = {
    "exciting": partial(_sines, one_rates=_ONE_TURN[0], one_turning=_ONE_TURN[1]),
    "brisk": partial(_sines, one_rates=_BRISK_TURN[0], one_turning=_BRISK_TURN[1]),
}
"""Excitations by name: functions of a key and the free axes (6,), which are 1 for free axes.

``"exciting"`` moves with an RMS velocity of 0.1 m/s, 0.4 rad/s with three free rotations and 0.5 rad/s with
one, up to 0.1 m and 0.45 rad from the start. A single free rotation turns further, because only the curvature
of its path reveals the position of a pin. ``"brisk"`` turns a single free rotation as fast as in the paper's
Table 4: 0.75 to 0.9 rad/s RMS, up to 0.7 rad, with rates up to the 2 and 3 rad/s of the paper's experimenter.
A hinge then often takes the arm to its limits, which the status reports.
"""


def guide_drive(key: jax.Array, frame: Frame, excitation: Excitation, step: float) -> Drive:
    """Return the drive of a hand with a random misalignment and tremor, for steps of ``step`` s.

    The state of the drive is the target pose (4, 4), m, of the tool, without the misalignment.
    """
    dtype = frame.position.dtype
    pairs = (_STIFFNESS, _DAMPING, _MISALIGNMENT, _TREMOR)
    stiffness, damping, offset, size = (by_axis(pair, dtype) for pair in pairs)
    offset_key, phase_key = jax.random.split(key)
    aside = transforms.pose_exp(offset * jax.random.normal(offset_key, (6,), dtype))
    rates = jnp.asarray(_TREMOR_RATES, dtype=dtype)
    phases = jax.random.uniform(phase_key, (6, len(_TREMOR_RATES)), dtype, maxval=2 * jnp.pi)
    size = size * (2 / len(_TREMOR_RATES)) ** 0.5  # scale the sum of sines to the given RMS

    def drive(pose: jax.Array, t: jax.Array, motion: Motion) -> tuple[jax.Array, jax.Array]:
        rotation, position = pose[:3, :3], pose[:3, 3]
        twist = ground_twist(locate(frame, rotation, position), frame.free * jnp.concatenate(excitation(t)))
        goal = matmul(pose, aside)
        apart = matmul(goal[:3, :3], motion.rotation.T)
        gap = jnp.concatenate([rotations.vee(apart), goal[:3, 3] - motion.position])
        tremor = size * jnp.sum(jnp.sin((rates * t)[None] + phases), axis=-1)
        wrench = stiffness * gap + damping * (twist - motion.twist) + _ease(t) * tremor
        # in body axes, because the exponential map takes a body twist
        turned = jnp.concatenate([apply(rotation.T, twist[:3]), apply(rotation.T, twist[3:])])
        moved = matmul(pose, transforms.pose_exp(step * turned))
        return moved, jnp.sum(motion.jacobian * wrench[:, None], axis=0)

    return drive


def demonstration_keys(key: jax.Array, numbers: jax.Array) -> jax.Array:
    """Random keys (N, 4) of numbered demonstrations, for geometry, hand, excitation and sensors."""
    return jax.vmap(lambda number: jax.random.split(jax.random.fold_in(key, number), 4))(numbers)


@partial(jax.jit, static_argnames=("steps", "excitation", "arm"))
def run_guided(
    frame: Frame,
    key: jax.Array,
    numbers: jax.Array,
    joints: jax.Array,
    velocity: jax.Array,
    end: jax.Array,
    imperfections: Imperfections,
    *,
    steps: Steps,
    excitation: str | Excitation,
    arm: Arm,
) -> Track:
    """Simulate N demonstrations with given numbers (N,), with one program for every constraint.

    They start at joint positions and velocities (N, 7), rad and rad/s, which obey the constraints. At the
    time ``end`` (s), the hand has come to rest; an infinite time means that the hand keeps moving.
    """
    step, compliance = steps.length, compliance_of(imperfections, joints.dtype)

    def simulate_one(frame: Frame, keys: jax.Array, start: jax.Array, velocity: jax.Array) -> Track:
        wanted = EXCITATIONS[excitation](keys[1], frame.free) if isinstance(excitation, str) else excitation

        def velocities(t: jax.Array) -> tuple[jax.Array, jax.Array]:
            angular, linear = wanted(t)
            fraction = _ease(end - t)
            return fraction * angular, fraction * linear

        drive = guide_drive(keys[0], frame, velocities, step)
        pose = transforms.make_pose(*forward_kinematics(start, arm))
        law = partial(hold, frame.free, step=step, compliance=compliance)
        return integrate(arm, frame, start, drive, pose, law, steps, velocity=velocity)

    return jax.vmap(simulate_one)(frame, demonstration_keys(key, numbers)[:, 1:3], joints, velocity)


@partial(jax.jit, static_argnames="arm")
def record(
    joints: jax.Array, key: jax.Array, numbers: jax.Array, imperfections: Imperfections, *, arm: Arm
) -> tuple[jax.Array, jax.Array]:
    """Compute recorded and true poses (N, K+1, 4, 4), m, from joint positions (N, K+1, 7), rad."""
    given = jax.tree.map(lambda number: jnp.asarray(number, dtype=joints.dtype), imperfections)

    def read(joints: jax.Array, key: jax.Array) -> jax.Array:
        noise = jax.random.normal(jax.random.split(key)[0], joints.shape, joints.dtype)
        return round_to(joints + given.encoder_noise * noise, given.encoder_step)

    measured = jax.vmap(read)(joints, demonstration_keys(key, numbers)[:, 3])
    poses, exact = (transforms.make_pose(*forward_kinematics(each, arm)) for each in (measured, joints))
    return poses, exact


@partial(jax.jit, static_argnames="arm")
def impact_velocity(frame: Frame, joints: jax.Array, velocity: jax.Array, *, arm: Arm) -> jax.Array:
    """Compute joint velocities (N, 7), rad/s, after constraints become active: an impact without rebound."""

    def one(frame: Frame, joints: jax.Array, velocity: jax.Array) -> jax.Array:
        motion = arm_motion(joints, velocity, arm)
        located = locate(frame, motion.rotation, motion.position)
        rows = (1 - frame.free)[:, None] * times(twist_map(located), motion.jacobian)
        response = solve_positive(motion.mass[..., None], rows.T)
        # free axes have zero rows; a one on their diagonal gives a zero impulse
        stopping = times(rows, response) + jnp.diag(frame.free)
        impulse = solve_positive(stopping, times(rows, velocity))
        return velocity - times(response, impulse)

    return jax.vmap(one)(frame, joints, velocity)
