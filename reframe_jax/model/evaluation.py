"""Evaluate entries of the table at given parameters: their amplitudes and their evidence.

Arrays have components first, then scales, entries and windows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.small import (
    invert_symmetric,
    materialize,
    pick,
    sandwich,
    times,
    total,
    trace,
    unit_matrix,
)
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.model import features as z
from reframe_jax.model.evidence import Amplitudes, Coordinates, Spectra, amplitudes_of, log_evidence
from reframe_jax.model.features import Features
from reframe_jax.model.moments import Moments
from reframe_jax.model.rows import Forms, coordinates_at, in_body
from reframe_jax.model.steps import Unknowns, tilted_axis
from reframe_jax.model.table import KINDS, ROWS, Table

Array = jax.Array
_CONSTANT = 1e-18  # m^2 or rad^2, variance below which numbers are constant


class WindowStatistics(NamedTuple):
    """Statistics of N windows that the evaluation of entries needs."""

    spectra: Spectra  # statistics (S, 1, N) of the scales
    mean: Array  # (3, 3, N) mean rotation
    rotations: Array  # (3, 3, M, N) rotations of M poses of the window
    levers: Array  # (3, 3, 5, N) m^2, squared sensitivity to a rotation of every translation in ``PATHS``
    universal: "UniversalMoments"  # of the coordinates of a universal joint


class UniversalMoments(NamedTuple):
    """Rotations of a universal joint: the angle between its axes, and the rotations about each axis."""

    ground: Array  # (3, N) axis a, fixed in the ground
    body: Array  # (3, N) axis b, fixed in the body
    form: Array  # (3, 3, S, N) moments of the three coordinates
    sine: Array  # (M, N) squared sine of the angle at M poses


def window_statistics(
    features: Features,
    moments: Moments,
    scale_weight: Array,
    paths: Array,
    noise: Array,
    origins: Array,
    universal_axes: Array,
) -> WindowStatistics:
    """Collect the statistics of N windows.

    Args:
        features: features of the windows.
        moments: moments of all scales.
        scale_weight: (N, S) weights of the scales in an amplitude.
        paths: (3, 3, S, 5, N) m^2, moments of the translations in ``PATHS`` at ``origins``.
        noise: (N, 2) m and rad, white noise of a pose.
        origins: (3, 4, N) m, origin of every linear type.
        universal_axes: (2, 3, N) axes a and b of the universal joint.
    """
    rotations = jnp.moveaxis(features.to_rotation[:, :, z.TURN_GROUND], 0, -1).transpose(1, 2, 0, 3)
    levers = _squared_levers(features, rotations, origins)
    turns = jnp.moveaxis(moments.products[:, 0, z.TURN_BODY, z.TURN_BODY], 0, -1)
    noise = _limited_noise(paths[:, :, 0], turns, levers, moments.details[:, 0], noise.T)
    return WindowStatistics(
        spectra=Spectra(*(s[:, None] for s in (moments.details.T, scale_weight.T, moments.white.T, noise))),
        mean=jnp.moveaxis(features.mean_rotation, 0, -1),
        rotations=rotations,
        levers=levers,
        universal=_universal_moments(universal_axes[0], universal_axes[1], moments.products, features),
    )


def evaluate_entries(
    forms: Forms, at: Unknowns, entries: Table, windows: WindowStatistics
) -> tuple[Amplitudes, Array]:
    """Compute the amplitudes and the log evidence (entries, N) of entries.

    Args:
        forms: moments about the origins, with the axes (entries, N) last.
        at: frames, origins, tilts and pitches of the entries.
        entries: rows of the table.
        windows: statistics of the windows.
    """
    turns, shifts, mixed = coordinates_at(forms, at, entries.apart)
    universal, crossed = windows.universal, entries.crossed
    # ---- a universal joint has its own rotation coordinates
    turns = jnp.where(crossed, universal.form[:, :, :, None], turns)
    # ---- sensitivity to a rotation
    unit = unit_matrix(turns.dtype, 2) + jnp.zeros_like(at.frame)
    sine = total(universal.sine, 0) / len(universal.sine)
    corner = (np.arange(9) == 0).reshape(3, 3, 1, 1)
    of_turns = jnp.where(crossed & corner, sine, unit)
    lever = pick(windows.levers, entries.path, 2)
    lever = materialize(sandwich(at.frame, lever[:, :, None]))[:, :, 0]
    third = (np.arange(3) == 2)[:, None, None]
    row = entries.apart & (third[:, None] | third[None])
    lever = jnp.where(row, jnp.where(third[:, None] & third[None], at.pitch**2, 0), lever)
    # ---- derivative of the coordinates with respect to the pose
    axis = times(windows.mean[:, :, None], times(at.frame, tilted_axis(at.tilt)))
    along = total(windows.rotations[:, :, :, None] * at.frame[None, :, 2, None], 1)
    cosine = total(along * axis[:, None], 0)
    det = jnp.where(entries.apart & in_body(entries), jnp.abs(cosine), 1.0)
    det = jnp.where(crossed, universal.sine[:, None], det)
    gain = jnp.asarray([0.0, 0, 0, 1, 1, 1], turns.dtype)[:, None, None]
    consistency = total(jnp.log(det + 1e-6), 0) / len(det)
    coordinates = Coordinates(turns, shifts, mixed, jnp.stack([of_turns, lever]), gain, consistency)
    amplitudes = amplitudes_of(materialize(coordinates), entries, windows.spectra)
    tilt = jnp.where(entries.tied, jnp.sqrt(total(at.tilt**2, 0) + jnp.finfo(turns.dtype).tiny), 0)
    return amplitudes, log_evidence(amplitudes, tilt, entries, windows.spectra.noise)


def _universal_moments(a: Array, b: Array, products: Array, features: Features) -> UniversalMoments:
    """Moments of a'R b and of the rotations about a and b; see :class:`UniversalMoments`."""
    rows = jnp.asarray(ROWS, products.dtype)
    angle = jnp.einsum("in,jn,ijf->nf", a, b, rows[KINDS.index("angle between"), :, 1:])
    turns = [
        jnp.einsum("in,if->nf", v, rows[KINDS.index(f"turn in {where}"), :, 0])
        for v, where in ((a, "ground"), (b, "body"))
    ]
    weights = jnp.stack([angle, *turns])
    half = jnp.einsum("inf,nsfg->nsig", weights, products, precision="highest")
    form = jnp.einsum("nsif,jnf->ijsn", half, weights, precision="highest")
    cosine = jnp.einsum("in,nmij,jn->mn", a, features.to_rotation[:, :, z.TURN_GROUND], b)
    return UniversalMoments(a, b, form, 1 - cosine * cosine)


def _squared_levers(features: Features, rotations: Array, origins: Array) -> Array:
    """Squared sensitivity to a rotation of every translation in ``PATHS``, (3, 3, 5, N) m^2."""
    sensitive = jnp.moveaxis(features.to_rotation[:, :, z.IN_BODY], 0, -1)
    inside = jnp.stack([sensitive[:, 2, 1], sensitive[:, 0, 2], sensitive[:, 1, 0]])  # R'p, (3, M, N)
    x = origins[:, :, None]
    moved = [
        jnp.broadcast_to(x[:, LinearType.BB], inside.shape),
        times(rotations, jnp.broadcast_to(x[:, LinearType.GB], inside.shape)),
        x[:, LinearType.GG] - times(rotations, inside),
        times(rotations.swapaxes(0, 1), jnp.broadcast_to(x[:, LinearType.BG], inside.shape)) - inside,
        jnp.zeros_like(inside),
    ]
    arms = jnp.stack(moved, axis=2)  # (3, M, 5, N)
    squares = total(arms[:, None] * arms[None], 2) / arms.shape[1]
    return unit_matrix(arms.dtype, 2) * trace(squares) - squares


def _limited_noise(paths: Array, turns: Array, levers: Array, details: Array, noise: Array) -> Array:
    """White noise (2, N), m and rad, of positions and rotations: no more than the axes of least motion show.

    The least variance along any axis is at most 3 / tr(C^-1) for the covariance C. A part of it, at most the
    noise of rotations times the squared lever, comes from rotations.

    Args:
        paths: (3, 3, 5, N) m^2, moments of the differences of consecutive poses, for every translation.
        turns: (3, 3, N) rad^2, the same of the rotation.
        levers: (3, 3, 5, N) m^2, see :class:`WindowStatistics`.
        details: (N,) number of these differences; 0 if the poses have no order.
        noise: (2, N) m and rad, estimates from the poses.
    """
    forms = jnp.concatenate([paths, turns[:, :, None]], axis=2)
    unit = jnp.broadcast_to(unit_matrix(forms.dtype, 2), turns[:, :, None].shape)
    inverse, _ = invert_symmetric([forms[i, j] for i, j in INDEX_PAIRS])
    of_rotation = total(inverse * jnp.concatenate([levers, unit], axis=2), 0, 1)
    of_position = jnp.concatenate([trace(inverse[:, :, :-1]), jnp.zeros_like(of_rotation[-1:])])
    varies = 3 / trace(inverse) > _CONSTANT  # a planar tracker, for example, does not measure all directions
    shown = jnp.max(jnp.where(varies, jnp.stack([of_position, of_rotation]), 0), axis=1)
    # the differences have twice the variance of the noise
    return jnp.where(details > 0, jnp.minimum(noise, jnp.sqrt(3 / (2 * shown) + 1e-16)), noise)
