"""Controllers: wrenches along the axes of a control frame, as a function of the travel along the axes."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from reframe_jax.constraints.frame import Frame, Located, locate, slip, twist_map
from reframe_jax.geometry.products import apply
from reframe_jax.simulation.arm.imperfections import by_axis
from reframe_jax.simulation.arm.model import Motion
from reframe_jax.simulation.arm.rollout import Drive

Pair = tuple[float | jax.Array, float | jax.Array]
_State = tuple[Located, jax.Array]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Controller:
    """A controller of wrenches along the axes of a control frame; every field is (rotations, translations).

    Along free axes, the controller applies a constant push, and a spring and a damper to a set point that
    moves with ``speed`` up to the distance ``reach``. Along constrained axes, it applies a spring and a
    damper to the start. Special cases: :func:`constant_wrench`, :func:`hybrid`, :func:`axis_impedance`.

    Attributes:
        push: N m, N, along free axes, towards the goal.
        speed: rad/s, m/s, speed of the set point.
        reach: rad, m, distance that the set point moves.
        stiffness, damping: N m/rad, N/m; N m s/rad, N s/m, along free axes.
        held_stiffness, held_damping: the same along constrained axes.
    """

    push: Pair = (0.0, 0.0)
    speed: Pair = (0.0, 0.0)
    reach: Pair = (math.inf, math.inf)
    stiffness: Pair = (0.0, 0.0)
    damping: Pair = (0.0, 0.0)
    held_stiffness: Pair = (0.0, 0.0)
    held_damping: Pair = (0.0, 0.0)


def constant_wrench(moment: float = 3.5, force: float = 7.0) -> Controller:
    """The paper's controller: constant moments (N m) and forces (N) along free axes only."""
    return Controller(push=(moment, force))


def hybrid(speed: Pair = (0.3, 0.08)) -> Controller:
    """Return a hybrid controller, with a ``speed`` in rad/s along free rotations, m/s along translations.

    It commands this velocity along free axes, and zero force and torque along constrained axes.
    """
    return Controller(speed=speed, damping=(5.0, 120.0))


def axis_impedance(speed: Pair = (0.3, 0.08), reach: Pair = (0.5, 0.15)) -> Controller:
    """Impedance per axis: stiff along free axes towards a moving set point, soft along constrained axes.

    The set point moves with ``speed`` (rad/s, m/s) up to ``reach`` (rad, m); beyond the end-stop, it presses
    against the end-stop.
    """
    return Controller(
        speed=speed,
        reach=reach,
        stiffness=(40.0, 600.0),
        damping=(4.0, 60.0),
        held_stiffness=(2.0, 40.0),
        held_damping=(0.4, 8.0),
    )


def control_drive(controller: Controller, frame: Frame, goal: jax.Array) -> Drive:
    """Return the drive of a controller, which moves along the free axes in the direction ``goal`` (6,).

    The state of the drive is the located control frame, and the travel (6,) of its axes in rad and m.
    """
    wanted = {name: by_axis(pair, goal.dtype) for name, pair in vars(controller).items()}

    def drive(state: _State, t: jax.Array, motion: Motion) -> tuple[_State, jax.Array]:
        before, made = state
        now = locate(frame, motion.rotation, motion.position)
        made = made + slip(before, now)
        rows = twist_map(now)
        velocity = apply(rows, motion.twist)
        point = jnp.minimum(wanted["speed"] * t, wanted["reach"]) * goal
        pace = jnp.where(wanted["speed"] * t < wanted["reach"], wanted["speed"], 0) * goal
        free = wanted["push"] * goal + wanted["stiffness"] * (point - made)
        free = free + wanted["damping"] * (pace - velocity)
        held = -wanted["held_stiffness"] * made - wanted["held_damping"] * velocity
        along = jnp.where(frame.free > 0, free, held)
        return (now, made), apply(motion.jacobian.T, apply(rows.T, along))

    return drive
