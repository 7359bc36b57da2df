"""The objective over a plane of positions, as the search for a frame's origin sees it."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import Packed, unpack
from reframe_jax.constraints.located import ground_offset
from reframe_jax.constraints.types import LinearType
from reframe_jax.identification.evidence import Evidence
from reframe_jax.identification.options import Lag, lag_in_samples
from reframe_jax.identification.programs import reduce_one
from reframe_jax.identification.results import Identification
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.objectives.velocity import PositionObjective
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
    norm: float = 0.0,
    discretization: Discretization = "chord",
    lag: Lag = "auto",
) -> jax.Array:
    """Evaluate the norm, in m/s, of the best-oriented frame of a type at given origins.

    Args:
        poses: (K+1, 4, 4), m.
        positions: (..., 3) m, origins in the body of the type's second letter.
        times: (K+1,) s.
        linear_type: of the frame.
        norm: exponent of the power mean over axes.
        discretization: see :func:`reframe_jax.motion.kinematics.linear_velocity_maps`.
        lag: between the two poses of a velocity, as in :func:`reframe_jax.identify`.

    Returns:
        (...).

    Raises:
        ValueError: if the lag is none, or does not go with the discretization.
    """
    poses, times = jnp.asarray(poses), jnp.asarray(times)
    steps, kind = jnp.diff(times), LinearType(linear_type)
    rule, samples = lag_in_samples(lag, np.asarray(steps), discretization)
    seen, _ = reduce_one(poses[None], steps, None, samples, rule=rule, discretization=discretization)
    return _norms(seen, jnp.asarray(positions), int(kind), norm)


@partial(jax.jit, static_argnames="norm")  # the type is not: one program serves all four
def _norms(seen: Packed, positions: jax.Array, kind: jax.Array, norm: float) -> jax.Array:
    evidence: Evidence = unpack(seen)
    offset = ground_offset(evidence.centre[0])[kind]
    positions = positions - offset.reshape((1,) * (positions.ndim - 1) + (3,))
    moments = evidence.linear[:, :, 0]
    one = moments[..., kind].reshape(*moments.shape[:2], *([1] * (positions.ndim - 1)))
    return jnp.exp(PositionObjective(one, norm).value(jnp.moveaxis(positions, -1, 0)))


def plot_landscape(
    poses: ArrayLike,
    found: Identification,
    *,
    times: ArrayLike,
    linear_types: Sequence[LinearType] | None = None,
    span: float = 0.5,
    points: int = 161,
    norm: float = 0.0,
    discretization: Discretization = "chord",
    lag: Lag = "auto",
    title: str | None = None,
) -> "Figure":
    """Draw the norm over planes through the identified position, one row per frame type.

    Where a type leaves the position free (:class:`LinearFrame`), or the frames are ``refined``, it is not
    the lowest point. The planes are those of the axes x-y, x-z and y-z of the body that the type's second
    letter names.

    Args:
        poses: (K+1, 4, 4), m.
        found: identification of these poses.
        times: (K+1,) s.
        linear_types: types to draw; by default the identified one.
        span: m, from the optimum to the edge.
        points: number of points along each side.
        norm: exponent of the power mean over axes.
        discretization: the one of the identification.
        lag: the one of the identification.
        title: of the figure.

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
            fields.append(
                np.asarray(
                    landscape(
                        poses,
                        positions,
                        times=times,
                        linear_type=kind,
                        norm=norm,
                        discretization=discretization,
                        lag=lag,
                    )
                )
            )
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
