"""Hand-like motions with random geometry, and the errors that trackers make.

Everything works under ``vmap`` and ``jit`` with explicit keys. The integrator compiles once per number of
samples and excitation, whatever the constraint, its geometry, the sample time and the errors.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.constraints.catalogue import constraint
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.geometry import rotations, transforms
from reframe_jax.geometry.products import apply, matmul
from reframe_jax.simulation.synthetic import Excitation, Simulation, pitch_of, simulate

__all__ = ["PoseErrors", "disturb", "random_constraint", "random_motion"]

_REACH = 0.5  # m, half the width of the cubes in which positions are drawn


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseErrors:
    """Errors of a tracker. All are numbers or scalar arrays, so you can batch them.

    Attributes:
        sigma: m, standard deviation of white noise in each component of the position.
        rotation_ratio: rad/m, from each size in m, here and below, to that of the same error in each
            component of the rotation vector.
        outliers: share of the poses that jump away, for one sample.
        jump: m, standard deviation of each component of such a jump.
        slow: m, standard deviation of an error that changes slowly, a first-order autoregression.
        slow_time: s, after which the correlation of that error has fallen to 1/e.
        rounding: m, of the last digit that positions are written with, 0 for none; quaternions are written
            to ``rotation_ratio`` / 2 times that, which turns by as much as ``rotation_ratio`` says.
    """

    sigma: float | jax.Array = 0.0
    rotation_ratio: float | jax.Array = 3.0
    outliers: float | jax.Array = 0.0
    jump: float | jax.Array = 0.05
    slow: float | jax.Array = 0.0
    slow_time: float | jax.Array = 1.0
    rounding: float | jax.Array = 0.0


@jax.jit
def disturb(poses: jax.Array, key: jax.Array, errors: PoseErrors, dt: float | jax.Array) -> jax.Array:
    """Return poses as a tracker would measure them.

    Errors of rotation turn about the axes of the ground: R becomes exp(e) R. The noise depends on the key
    alone: other error sizes scale the same noise.

    Args:
        poses: (K+1, 4, 4), m.
        key: of the errors.
        errors: their kinds and sizes.
        dt: sample time, s.

    Returns:
        (K+1, 4, 4), m.
    """
    errors = jax.tree.map(lambda size: jnp.asarray(size, dtype=poses.dtype), errors)
    white_key, which_key, jump_key, slow_key = jax.random.split(key, 4)
    shape, dtype = (poses.shape[0], 6), poses.dtype
    sizes = jnp.concatenate([jnp.full(3, errors.rotation_ratio), jnp.ones(3, dtype)])[None]
    jumps = jax.random.bernoulli(which_key, errors.outliers, shape[:1]).astype(dtype)[:, None]
    error = errors.sigma * jax.random.normal(white_key, shape, dtype)
    error = error + errors.jump * jumps * jax.random.normal(jump_key, shape, dtype)
    memory = jnp.exp(-dt / errors.slow_time).astype(dtype)
    error = error + errors.slow * _autoregression(jax.random.normal(slow_key, shape, dtype), memory)
    turn, shift = jnp.split(sizes * error, 2, axis=-1)
    rotation = matmul(rotations.rotation_exp(turn), poses[:, :3, :3])
    quaternion = _rounded(rotations.rotation_to_quaternion(rotation), errors.rotation_ratio / 2, errors)
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    rotation = jnp.where(errors.rounding > 0, rotations.quaternion_to_rotation(quaternion), rotation)
    return transforms.make_pose(rotation, _rounded(poses[:, :3, 3] + shift, 1.0, errors))


def random_constraint(
    label: str, key: jax.Array, *, linear_type: LinearType | None = None
) -> tuple[ConstraintFrame, jax.Array]:
    """Draw a constraint of random geometry, and the first pose of the body.

    The frame is turned at random; its origin lies anywhere within 0.5 m of that of the body, along each
    axis, at the start. So does the body's from the ground's, turned at random too. Both parts of the frame
    are oriented in the same body, so every start keeps the class.

    Args:
        label: label or name of a constraint.
        key: JAX random key of the geometry, which is the same for all labels, up to the body that it is given
            in.
        linear_type: as in :meth:`ConstraintFrame.named`.

    Returns:
        The frame, and the pose (4, 4) in m.

    Raises:
        KeyError: for an unknown label.
        ValueError: for a linear type that cannot express the constraint.
    """
    entry = constraint(label)
    kind = entry.linear_type if linear_type is None else linear_type
    rotvec, in_body, in_ground, start = _geometry(key)
    in_the_ground = kind is not None and kind.position_body == AngularType.G
    position = in_ground if in_the_ground else in_body
    frame = ConstraintFrame.named(entry.label, linear_type=kind, rotvec=rotvec, position=position)
    return frame, start


def random_motion(
    label: str,
    key: jax.Array,
    *,
    samples: int,
    dt: float,
    excitation: str | Excitation = "hand",
    errors: PoseErrors = PoseErrors(),
    linear_type: LinearType | None = None,
    pitch: float | jax.Array | None = None,
) -> Simulation:
    """Draw a motion under a constraint of random geometry, with the errors of a tracker.

    One key gives the same geometry and motion at every sample time, as long as ``samples * dt`` is the same,
    and whatever the errors are.

    Args:
        label: label or name of a constraint.
        key: JAX random key of the geometry, the excitation and the errors.
        samples: K, number of steps.
        dt: sample time, s; a plain number.
        excitation: a name of :data:`reframe_jax.simulation.synthetic.EXCITATIONS`, or a function of time.
        errors: of the tracker; none by default.
        linear_type: as in :func:`random_constraint`.
        pitch: m/rad of a screw; 0.05 by default for the label "screw", see :func:`.synthetic.simulate`.

    Returns:
        The recording, of K + 1 poses; the first of ``exact_poses`` is the start.

    Raises:
        KeyError: for an unknown label.
        ValueError: for an unknown excitation, or a linear type that cannot express the constraint.
    """
    geometry_key, motion_key, error_key = jax.random.split(key, 3)
    frame, start = random_constraint(label, geometry_key, linear_type=linear_type)
    exact = simulate(
        frame,
        motion_key,
        duration=samples * dt,
        dt=dt,
        excitation=excitation,
        start=start,
        pitch=pitch_of(label) if pitch is None else pitch,
    ).exact_poses
    times = dt * jnp.arange(samples + 1, dtype=exact.dtype)
    return Simulation(times, disturb(exact, error_key, errors, dt), exact, frame)


@jax.jit
def _geometry(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Orientation (3,) rad, position (3,) m in the body and in the ground, and first pose (4, 4)."""
    turn_key, start_key, here_key, there_key = jax.random.split(key, 4)
    rotation = rotations.quaternion_to_rotation(_random_quaternion(start_key))
    in_body, away = (
        jax.random.uniform(k, (3,), minval=-_REACH, maxval=_REACH, dtype=float) for k in (here_key, there_key)
    )
    rotvec = rotations.rotation_log(rotations.quaternion_to_rotation(_random_quaternion(turn_key)))
    return rotvec, in_body, apply(rotation, in_body) + away, transforms.make_pose(rotation, away)


def _random_quaternion(key: jax.Array) -> jax.Array:
    """(4,), every rotation as likely as any other."""
    four = jax.random.normal(key, (4,), dtype=float)
    return four / jnp.linalg.norm(four)


def _autoregression(white: jax.Array, memory: jax.Array) -> jax.Array:
    """Noise (K, n) of unit variance, each sample of which remembers so much of the one before."""
    fresh = jnp.sqrt(1 - memory**2)

    def advance(last: jax.Array, new: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = memory * last + fresh * new
        return now, now

    return jnp.concatenate([white[:1], jax.lax.scan(advance, white[0], white[1:])[1]])


def _rounded(values: jax.Array, ratio: float | jax.Array, errors: PoseErrors) -> jax.Array:
    """Values to the nearest multiple of the rounding times a ratio; as they are if that is zero."""
    digit = jnp.asarray(errors.rounding * ratio)
    unit = jnp.where(digit > 0, digit, 1)
    return jnp.where(digit > 0, unit * jnp.round(values / unit), values)
