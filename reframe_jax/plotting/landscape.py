"""Draw the objective of the search for a frame's origin over planes of positions."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.constraints.located import ground_offset
from reframe_jax.constraints.types import LinearType
from reframe_jax.identification.options import Scales, take_scales
from reframe_jax.identification.preparation import prepare_windows
from reframe_jax.identification.results import Identification
from reframe_jax.model.search import norm_at, polynomials
from reframe_jax.model.solve import choose_scales
from reframe_jax.model.table import KINDS, ROWS
from reframe_jax.plotting.style import CONSTRAINED, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["landscape", "plot_landscape"]


def landscape(
    poses: ArrayLike,
    positions: ArrayLike,
    *,
    times: ArrayLike,
    linear_type: LinearType,
    scales: Scales = "auto",
) -> jax.Array:
    """Evaluate the norm, in m/s, of the best-oriented frame of a type at given origins.

    Args:
        poses: (K+1, 4, 4), m.
        positions: (..., 3) m, origins in the body of the type's second letter.
        times: (K+1,) s.
        linear_type: type of the linear frame.
        scales: time scales of the identification, see :func:`reframe_jax.identify`.

    Returns:
        (...) the norm, m/s; at an identified origin, it equals ``found.linear.norms``.

    Raises:
        ValueError: if the scales do not fit the window.
    """
    samples = take_scales(scales, len(np.asarray(poses)))
    steps = jnp.diff(jnp.asarray(times))
    return _norms(jnp.asarray(poses), steps, jnp.asarray(positions), int(linear_type), samples)


@partial(jax.jit, static_argnames="scales")
def _norms(
    poses: jax.Array, steps: jax.Array, positions: jax.Array, kind: jax.Array, scales: tuple[int, ...] | None
) -> jax.Array:
    window = prepare_windows(poses[None], steps, None, None, scales)
    used = choose_scales(window.moments, window.noise, scales)
    rows = np.stack([ROWS[KINDS.index(each.name)] for each in LinearType])
    products = jnp.moveaxis(used.products, (0, 1), (3, 2))
    one = polynomials(products, rows)[:, :, :, kind][:, :, :, None]
    points = positions.reshape(-1, 3) - ground_offset(window.centre[0])[kind]
    value = norm_at(one, used.details.T, points.T[:, None])[0]
    # the objective is a sum of log det(Sigma): one sixth is the mean log RMS displacement per axis
    details = used.details[0]
    spans = jnp.sum(details * jnp.log(used.width[0] * jnp.mean(steps)))
    return jnp.exp((value / 6 - spans) / jnp.sum(details)).reshape(positions.shape[:-1])


def plot_landscape(
    poses: ArrayLike,
    found: Identification,
    *,
    times: ArrayLike,
    linear_types: Sequence[LinearType] | None = None,
    span: float = 0.5,
    points: int = 161,
    scales: Scales = "auto",
    title: str | None = None,
) -> "Figure":
    """Draw the norm over planes through the identified position, one row per frame type.

    The identified origin belongs to the fitted constraint and is close to the minimum. The planes are the
    x-y, x-z and y-z planes of the body that the type's second letter names.

    Args:
        poses: (K+1, 4, 4), m.
        found: identification of these poses.
        times: (K+1,) s.
        linear_types: types to draw; by default the identified type.
        span: m, distance from the identified position to the edge.
        points: number of points along each side.
        scales: time scales of the identification.
        title: title of the figure.

    Raises:
        ImportError: if Matplotlib is not installed.
    """
    kinds = [LinearType(int(found.linear.type_code))] if linear_types is None else list(linear_types)
    figure = new_figure(8.4, 2.3 * len(kinds) + 0.3)
    grid = figure.subplots(len(kinds), 3, squeeze=False)
    line = np.linspace(-span, span, points)
    optima = np.asarray(found.candidates.linear.position)
    fields = []
    for kind in kinds:
        for i, j in ((0, 1), (0, 2), (1, 2)):
            positions = np.tile(optima[int(kind)], (points, points, 1))
            positions[..., i] += line[None, :]
            positions[..., j] += line[:, None]
            values = landscape(poses, positions, times=times, linear_type=kind, scales=scales)
            fields.append(np.asarray(values))
    from matplotlib.colors import LogNorm

    low, high = (float(f(field)) for f, field in ((np.min, fields), (np.max, fields)))
    scale = LogNorm(low, high)
    image = None
    for number, field in enumerate(fields):
        row, (i, j) = number // 3, ((0, 1), (0, 2), (1, 2))[number % 3]
        axes, at = grid[row, number % 3], optima[int(kinds[row])]
        extent = (at[i] - span, at[i] + span, at[j] - span, at[j] + span)
        image = axes.imshow(field, origin="lower", extent=extent, cmap="cividis", norm=scale)
        levels = np.geomspace(low, high, 12)[1:-1]
        axes.contour(field, levels, extent=extent, colors="white", linewidths=0.4, alpha=0.6)
        axes.plot(at[i], at[j], "x", color=CONSTRAINED[0], markersize=6)
        axes.set_xlabel(f"{'xyz'[i]} [m]", fontsize=8)
        axes.set_ylabel(f"{'xyz'[j]} [m]", fontsize=8)
        axes.set_title(f"{kinds[row]}", fontsize=9)
        axes.tick_params(labelsize=7)
    if image is not None:
        figure.colorbar(image, ax=grid, label="norm [m/s]", shrink=0.9)
    if title is not None:
        figure.suptitle(title, fontsize=11)
    return figure
