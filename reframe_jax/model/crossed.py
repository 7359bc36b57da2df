"""Find the two axes of a universal joint: one in each body, at a constant right angle.

The angle between an axis a of the ground and an axis b of the body is constant: a'R b is a held coordinate
with variance c_s(a, b), bilinear in the moments of R. Levenberg-Marquardt steps minimise sum_s n_s log c_s. A
penalty -log sin^2 keeps the mean angle near a right angle: axes at any other angle may fit a short motion by
chance, and parallel axes fit every motion.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.kernel import added_up
from reframe_jax.geometry.small import materialize, normalize, pick, times, total, trace, unit_matrix
from reframe_jax.model.descent import Local, levenberg_marquardt

Array = jax.Array
_LEFT, _RIGHT = np.array([0, 1, 0], np.int32), np.array([0, 1, 1], np.int32)  # axes of a block
_APART = 3.0  # factor of the penalty, per independent detail


def promising_pairs(
    forms: Array, details: Array, mean_matrix: Array, ground: Array, body: Array
) -> tuple[Array, Array]:
    """Choose, from nine pairs of axes, the three with the lowest objective: a (3, 3, N) and b (3, 3, N).

    The forms (3, 3, 3, 3, S, N) are the moments of R, entry by entry, ``details`` (S, N) the independent
    details of each scale, and ``mean_matrix`` (3, 3, N) is the mean of all R. The axes of the ground and of
    the body are columns of (3, 3, N). The mean cosine of the angle between two axes is a'E[R]b.
    """
    of_ground = total(forms[:, :, :, :, None] * ground[:, None, None, None, :, None], 0)
    of_ground = total(of_ground * ground[:, None, :, None], 1)  # (j, l, a, S, N)
    half = total(of_ground[:, :, :, None] * body[:, None, None, :, None], 0)
    size = total(half * body[:, None, :, None], 0) + jnp.finfo(forms.dtype).tiny ** 0.5
    cosine = times(jnp.swapaxes(ground, 0, 1), times(mean_matrix, body))
    value = total(details * jnp.log(size), 2) - _APART * total(details, 0) * jnp.log(_square_of_sine(cosine))
    best = jax.lax.top_k(-value.reshape(9, -1).T, 3)[1].T
    first, second = (pick(v, i, 1) for v, i in ((ground, best // 3), (body, best % 3)))
    return first, second


def crossed_axes(
    forms: Array, details: Array, mean_matrix: Array, ground: Array, body: Array, steps: int
) -> tuple[Array, Array, Array]:
    """Fit the two axes of a universal joint, from axes ``ground`` and ``body``, (3, ...).

    The other arguments are as in :func:`promising_pairs`. The result is the unit vectors a (3, ...) and b (3,
    ...), and the objective (...).
    """
    keep = _APART * total(details, 0)
    unit = unit_matrix(ground.dtype, ground.ndim - 1)

    def expand(axes: tuple[Array, Array]) -> Local:
        """Expand the objective about two axes. Changes of their lengths have no slope and no coupling."""
        a, b = axes
        held, blocks = _held_part(forms, details, a, b)
        turned = jnp.stack([times(mean_matrix, b), times(jnp.swapaxes(mean_matrix, 0, 1), a)], axis=1)
        cosine = total(a * turned[:, 0], 0)
        rest = _square_of_sine(cosine)
        pull = materialize(keep * turned)
        pair = jnp.stack([a, b], axis=1)
        along = pair[:, None] * pair[None]  # (3, 3, 2, ...)
        flat = materialize(unit[:, :, None] - along)
        gradient = times(blocks[:, :, :2], pair) + cosine / rest * pull
        bent = blocks + (2 - rest) / (rest * rest) * pull[:, None, _LEFT] * turned[None, :, _RIGHT]
        bent = times(times(flat[:, :, _LEFT], bent), flat[:, :, _RIGHT])
        value = held - keep * jnp.log(rest)
        diagonal = bent[:, :, :2] + along * trace(bent[:, :, :2])
        return Local(value, times(flat, gradient), diagonal, bent[:, :, 2:])

    def move(axes: tuple[Array, Array], step: Array) -> tuple[Array, Array]:
        return normalize(axes[0] + step[:, 0]), normalize(axes[1] + step[:, 1])

    (a, b), value = levenberg_marquardt(expand, move, (ground, body), jnp.zeros_like(ground[0]), 2, steps)
    return a, b, value


@partial(added_up, axes=(4, 0, -1, -1))
def _held_part(forms: Array, details: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """The objective (...) without the penalty, and half its Hessian (3, 3, 3, ...) without the change of c_s.

    The blocks of the Hessian are those of a, of b, and of a with b.
    """
    across = total(forms * b[:, None, None, None], 1)  # (i, k, l)
    half = total(forms * a[:, None, None, None, None], 0)  # (j, k, l)
    of_ground, of_body = total(across * b[:, None], 2), total(half * a[:, None, None], 1)
    both = total(across * a[:, None, None], 1)
    size = total(total(of_ground * a[:, None, None], 0) * a[:, None], 0) + jnp.finfo(a.dtype).tiny ** 0.5
    weight = details / size
    blocks = materialize([total(m * weight, 2) for m in (of_ground, of_body, both)])
    return total(details * jnp.log(size), 0), jnp.stack(blocks, axis=2)


def _square_of_sine(cosine: Array) -> Array:
    return jnp.maximum(1 - cosine * cosine, 1e-6)  # parallel within 1 mrad
