"""Starting parameters of the fit of every entry: common axes of a window, and a frame for every entry.

Components come first and windows last.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import AngularType
from reframe_jax.geometry.kernel import in_registers
from reframe_jax.geometry.small import cross, diagonalize, normalize, pick, times, total, unit_matrix
from reframe_jax.model import features as z
from reframe_jax.model.crossed import crossed_axes, promising_pairs
from reframe_jax.model.rows import rotation_forms
from reframe_jax.model.steps import Unknowns
from reframe_jax.model.table import ENTRIES, TABLE

Array = jax.Array
_CROSS_STEPS = 12  # steps of the search for the axes of a universal joint
_ALONG = 0.6  # sine of the angle below which two axes count as nearly parallel


class Axes(NamedTuple):
    """Axes that decorrelate the motion at all scales: right-handed columns, in ascending order of amplitude.

    Attributes:
        linear: (3, 3, 4, N) axes of the path of the origin with the lowest norm, for every linear type.
        angular: (3, 3, 2, N) axes of the rotation in the ground and in the body.
        path: (3, 3, N) axes of the position.
    """

    linear: Array
    angular: Array
    path: Array


def _sorted(axes: Array, size: Array) -> Array:
    """Sort columns (3, 3, ...) by ascending size (3, ...), and make them right-handed."""
    columns, sizes = [axes[:, k] for k in range(3)], [size[k] for k in range(3)]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        swap = sizes[i] > sizes[j]
        for values in (columns, sizes):
            one, two = values[i], values[j]
            values[i], values[j] = jnp.where(swap, two, one), jnp.where(swap, one, two)
    turned = total(columns[0] * cross(columns[1], columns[2]), 0)
    return jnp.stack([columns[0] * jnp.where(turned < 0, -1, 1), columns[1], columns[2]], axis=1)


def common_frames(paths: Array, turns: Array, position: Array, details: Array, scale_weight: Array) -> Axes:
    """Compute, for every window, the axes that the covariances of all scales have in common.

    The arguments are covariances at S scales: of the displacement of the origin with the lowest norm, for
    each linear type (3, 3, S, 4, N); of the rotation, in axes of the ground and of the body (3, 3, S, 2, N);
    and of the position (3, 3, S, N). Then, for every scale (S, N), the number of independent details, and the
    weight in the variance over the recording. Axes are columns, in ascending order of the amplitude.
    """
    whole = total(position * scale_weight, 2)
    single = jnp.zeros_like(position).at[:, :, 0].set(whole)
    forms = jnp.concatenate([paths, turns, single[:, :, :, None]], axis=3)
    first = jnp.zeros_like(details).at[0].set(1)
    weights = jnp.stack([details] * 6 + [first], axis=1)
    lift = 1e-18 * unit_matrix(forms.dtype, 3)
    axes = diagonalize(forms + lift, weights)
    sizes = jnp.concatenate([total(forms[:, :, :, :6] * scale_weight[:, None], 2), whole[:, :, None]], axis=2)
    axes = _sorted(axes, total(axes * times(sizes, axes), 0))
    return Axes(axes[:, :, :4], axes[:, :, 4:6], axes[:, :, 6])


def universal_axes(axes: Axes, products: Array, details: Array, mean_matrix: Array) -> tuple[Array, Array]:
    """Find the axes a of the ground and b of the body, (3, N), whose angle changes least.

    The products (27, 27, S, N) are the moments of the features, ``details`` (S, N) the independent details of
    every scale, and ``mean_matrix`` (3, 3, N) is the mean of all R.
    """
    forms = rotation_forms(products)
    ground, body = axes.angular[:, :, AngularType.G], axes.angular[:, :, AngularType.B]
    a, b = promising_pairs(forms, details, mean_matrix, ground, body)
    forms = forms[:, :, :, :, :, None]
    fit = in_registers(partial(crossed_axes, steps=_CROSS_STEPS), 2)
    a, b, value = fit(forms, details[:, None], mean_matrix[:, :, None], a, b)
    best = jnp.argmin(value, axis=0)[None]
    return pick(a, best, 1)[:, 0], pick(b, best, 1)[:, 0]


def entry_starts(origins: Array, axes: Axes, moments: Array, mean: Array) -> Unknowns:
    """Choose the starting unknowns of every entry, in the axes of its main body, with (E, N) last.

    The origins (3, 4, N), m, have the lowest norm of every linear type; the moments (27, 27, N) are those
    over all scales, and ``mean`` (3, 3, N) is the mean rotation.
    """
    kinds = np.array([entry.kind for entry in ENTRIES], np.int32)
    own = axes.linear[:, :, kinds]
    fixed = np.array([entry.kind.name[0] == "G" for entry in ENTRIES])[:, None]
    main = axes.angular[:, 2, AngularType.B]
    # entries whose rotations are held are written with the position, in the ground
    turn = jnp.where(fixed, times(mean, main)[:, None], main[:, None])
    choices = {"normal": own[:, 0], "along": own[:, 2]}
    choices |= {"path": axes.path[:, 2, None], "lift": axes.path[:, 0, None]}
    axis = turn
    for name, other in choices.items():
        axis = jnp.where(np.array([entry.start == name for entry in ENTRIES])[:, None], other, axis)
    # the axis of least motion of the type that is not nearly parallel to the axis
    cosine = total(axis[:, None] * own, 0)
    good = 1 - cosine * cosine > _ALONG**2
    across = jnp.where(good[0], own[:, 0], jnp.where(good[1], own[:, 1], own[:, 2]))
    first = normalize(across - axis * total(axis * across, 0))
    frame = jnp.stack([first, cross(axis, first), axis], axis=1)
    pair = moments[z.POSITION, z.TURN_BODY], moments[z.TURN_BODY, z.TURN_BODY]
    moving = total(times(mean, main) * times(pair[0], main), 0)
    pitch = moving / (total(main * times(pair[1], main), 0) + 1e-30)
    pitches = jnp.where(TABLE.pitch[:, None], pitch, 0)
    return Unknowns(frame, origins[:, kinds], jnp.zeros((2, *pitches.shape), pitches.dtype), pitches)
