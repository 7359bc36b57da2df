"""From errors of poses to errors of the paths that frames are estimated from.

To first order, the error of an estimate is a sum over the samples: its *sensitivity* to the path there times
the error of the path. This module turns sensitivities to paths into sensitivities to poses. The error of a
pose is a rotation vector e and a shift d in the ground: R becomes exp(e) R, p becomes p + d.

A point at the lever r from {b} moves by d + e x r. That is all for GB and BG, whose paths are positions. The
paths of BB and GG, and those of rotations, are sums of steps, and e also turns the two steps beside it. Steps
are taken along the mean axes of their ends, which is exact to second order in the step.

Arrays have rows (one for each estimate) and components first, then samples, then windows.
"""

from collections.abc import Callable
from typing import Any

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.compilation import once
from reframe_jax.constraints.types import AngularType, LinearType

__all__ = ["apply_to_rows", "cross_rows", "position_to_poses", "turn_to_poses"]


def position_to_poses(
    rows: jax.Array, kind: jax.Array, rotation: jax.Array, position: jax.Array, origin: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sensitivities to pose errors, from those to the path of a frame's origin.

    Args:
        rows: (m, 3, K+1, N) sensitivities to the path, in the axes of the body that the frame is oriented in.
        kind: (N,) linear type.
        rotation: (3, 3, K+1, N), of {b} in {g}.
        position: (3, K+1, N) m, of {b}.
        origin: (3, N) m, of the frame, in the body it is fixed in.

    Returns:
        Those to rotation vectors and those to shifts, (m, 3, K+1, N) each, in the axes of {g}.
    """
    fixed = jnp.broadcast_to(origin[:, None], position.shape)
    arm = once(apply_to_rows(rotation, fixed[None])[0])
    in_body, in_ground = (_steps_in_body, _steps_in_ground)
    candidates: dict[int, Callable[[], tuple[jax.Array, jax.Array]]] = {
        LinearType.BB: lambda: in_body(rows, rotation, position + arm, arm),
        LinearType.GB: lambda: _point(rows, arm),
        LinearType.GG: lambda: in_ground(rows, rotation, fixed - position),
        LinearType.BG: lambda: _point(once(apply_to_rows(rotation, rows)), fixed - position),
    }
    turn, shift = _of_kind(kind, candidates, (rows, rows))
    return turn, shift


def _of_kind(kind: jax.Array, candidates: dict[int, Callable[[], Any]], like: Any) -> Any:
    """What belongs to the type of each window; types that no window has are not computed."""
    result = like
    for code, compute in candidates.items():
        here = kind == int(code)

        def take(before: Any, here: jax.Array = here, compute: Callable[[], Any] = compute) -> Any:
            return jax.tree.map(
                lambda new, old: jnp.where(here[None, None, None], new, old), compute(), before
            )

        result = lax.cond(jnp.any(here), take, lambda before: before, result)
    return result


def turn_to_poses(rows: jax.Array, kind: jax.Array, rotation: jax.Array, turns: jax.Array) -> jax.Array:
    """Sensitivities to rotation errors of poses, from those to the summed rotation vectors of the steps.

    Args:
        rows: (m, 3, K+1, N) sensitivities to the path, in the axes of the body of the angular type.
        kind: (N,) angular type.
        rotation: (3, 3, K+1, N), of {b} in {g}.
        turns: (3, K+1, N) rad, the path itself.

    Returns:
        (m, 3, K+1, N), in the axes of {g}.
    """
    pull = _after(rows)
    candidates: dict[int, Callable[[], jax.Array]] = {
        AngularType.B: lambda: _differences(once(apply_to_rows(_middle(rotation), pull))),
        AngularType.G: lambda: _differences(pull) + _halves(cross_rows(jnp.diff(turns, axis=1)[None], pull)),
    }
    result: jax.Array = _of_kind(kind, candidates, rows)
    return result


def _point(rows: jax.Array, arm: jax.Array) -> tuple[jax.Array, jax.Array]:
    return cross_rows(arm[None], rows), rows


def _steps_in_body(
    rows: jax.Array, rotation: jax.Array, points: jax.Array, arm: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """BB: steps of a point of the body, in the axes of the body."""
    pull = once(apply_to_rows(_middle(rotation), _after(rows)))
    turn, shift = _point(once(_differences(pull)), arm)
    return turn - _halves(cross_rows(jnp.diff(points, axis=1)[None], pull)), shift


def _steps_in_ground(rows: jax.Array, rotation: jax.Array, arm: jax.Array) -> tuple[jax.Array, jax.Array]:
    """GG: a point of the ground passes the body; steps in the axes of the ground, of the body past it."""
    pull, middle = _after(rows), _middle(rotation)
    in_body = apply_to_rows(jnp.swapaxes(rotation, 0, 1), arm[None])[0]
    steps = once(-apply_to_rows(middle, jnp.diff(in_body, axis=1)[None]))
    on_poses = once(_differences(once(apply_to_rows(jnp.swapaxes(middle, 0, 1), pull))))
    turn, shift = _point(once(apply_to_rows(rotation, on_poses)), arm)
    return turn + _halves(cross_rows(steps, pull)), shift


def _after(rows: jax.Array) -> jax.Array:
    """Sensitivities to steps, (m, 3, K, N): those of all that comes after, added up."""
    return once(jnp.cumsum(rows[:, :, :0:-1], axis=2)[:, :, ::-1])


def _middle(rotation: jax.Array) -> jax.Array:
    return (rotation[:, :, 1:] + rotation[:, :, :-1]) / 2


def _differences(steps: jax.Array) -> jax.Array:
    """To poses, from the differences of their values over the steps."""
    edge = jnp.zeros_like(steps[:, :, :1])
    return jnp.concatenate([edge, steps], axis=2) - jnp.concatenate([steps, edge], axis=2)


def _halves(steps: jax.Array) -> jax.Array:
    """To poses, from their means over the steps."""
    edge = jnp.zeros_like(steps[:, :, :1])
    return (jnp.concatenate([edge, steps], axis=2) + jnp.concatenate([steps, edge], axis=2)) / 2


def apply_to_rows(matrix: jax.Array, rows: jax.Array) -> jax.Array:
    """Matrices (3, 3, ...) times every row of (m, 3, ...)."""
    return sum((matrix[None, :, j] * rows[:, None, j] for j in (1, 2)), matrix[None, :, 0] * rows[:, None, 0])


def cross_rows(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross products of (m, 3, ...) and (m, 3, ...)."""
    return jnp.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
