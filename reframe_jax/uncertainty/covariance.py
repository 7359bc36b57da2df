"""Compute the covariance of an identification."""

from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from reframe_jax.identification.certainty import Covariance
from reframe_jax.identification.options import Scales
from reframe_jax.identification.preparation import Prepared
from reframe_jax.identification.results import Identification
from reframe_jax.uncertainty.refit import Windows, over_windows, refit_windows
from reframe_jax.uncertainty.spread import combine_parts

Errors = Literal["measured", "white"]
"""Whether disagreement between parts of the recording widens a covariance, or errors count as white."""

Method = Literal["derivative", "bootstrap"]
"""Covariance from the curvature of the fit, or from fits that leave out a part of the recording."""

_LARGE_TURN = 0.2  # rad, largest standard deviation of a first-order covariance
_LARGE_SHIFT = 0.25  # largest standard deviation of the origin, as a fraction of half the search box


def covariance(
    found: Identification,
    poses: "ArrayLike",
    *,
    times: "ArrayLike | None" = None,
    dt: "ArrayLike | None" = None,
    scales: Scales = "auto",
    errors: Errors = "measured",
    method: Method = "derivative",
) -> Covariance:
    """Compute the covariance of the axes and the origin of an identification.

    The function fits the identified constraint again, with a likelihood in which every constrained
    coordinate has a separate variance at every time scale. The curvature of the likelihood gives the
    covariance; the number of independent values gives the width of Student's distribution. Trackers and
    bodies that flex also have slow errors, which the likelihood does not contain. By default, the function
    therefore also fits halves and thirds of the recording, and compares redundant estimates: the axis from
    positions with the axis from rotations. If their differences exceed chance, the half-widths of 95 %
    intervals are at least as large as these differences; a part counts only in directions that its motion
    determines. The covariance assumes that the identified types and degrees of freedom are correct.

    Args:
        found: the identification of these poses by :func:`reframe_jax.identify`, with the default norm and
            solver.
        poses: (..., K+1, 4, 4) m, the same as for the identification.
        times: (K+1,) or (..., K+1) s, the same as for the identification.
        dt: s, the same as for the identification.
        scales: the same as for the identification.
        errors: ``"measured"`` widens the covariance by the disagreement of parts; ``"white"`` does not.
        method: ``"derivative"`` uses the curvature of the likelihood. ``"bootstrap"`` works without a
            likelihood: it fits the constraint six times, each time without one of six blocks of the recording
            (the grouped jackknife).

    Returns:
        The covariance, with the leading axes of ``found``. It is NaN for failed windows, and for free axes
        that no entry of the table has, which only thresholds report.

    Raises:
        ValueError: if the poses differ from the poses of ``found``, or if options cannot be combined.
    """
    if errors not in get_args(Errors):
        raise ValueError(f"errors must be 'measured' or 'white', not {errors!r}.")
    if method not in get_args(Method):
        raise ValueError(f"method must be 'derivative' or 'bootstrap', not {method!r}.")
    if method == "bootstrap" and errors != "measured":
        raise ValueError("method='bootstrap' has no model of the errors: remove the option errors.")
    parts = "blocks" if method == "bootstrap" else "spans" if errors == "measured" else "whole"
    return over_windows(_window_covariances, found, poses, times, dt, scales, parts=parts)


def _window_covariances(window: Prepared, windows: Windows, scales: jax.Array, *, parts: str) -> Covariance:
    refit = refit_windows(window, windows, scales, parts)
    matrix, inflation = jax.vmap(partial(combine_parts, parts=parts))(refit)
    angles = jnp.sqrt(jnp.diagonal(matrix, axis1=1, axis2=2))
    small = jnp.max(angles[:, :6], axis=1) < _LARGE_TURN
    near = jnp.max(angles[:, 6:], axis=1) < _LARGE_SHIFT * window.box
    # with thresholds, free axes may have no entry in the table
    known = (windows.found.entry_code >= 0) & jnp.isfinite(windows.found.linear.position[:, 0])
    failed = (window.status >= 10) | ~known
    matrix = jnp.where(failed[:, None, None], jnp.nan, matrix)
    return Covariance(matrix, jnp.where(failed[:, None], jnp.nan, inflation), small & near & ~failed)
