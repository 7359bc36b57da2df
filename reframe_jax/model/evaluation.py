"""Evaluate entries of the table at given parameters: their amplitudes and their evidence.

Arrays have components first, then scales, entries and windows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.kernel import in_registers
from reframe_jax.geometry.small import invert_symmetric, materialize, pick, times, total, trace, unit_matrix
from reframe_jax.geometry.symmetric import INDEX_PAIRS
from reframe_jax.model import features as z
from reframe_jax.model.amplitudes import Spectra, amplitudes_of
from reframe_jax.model.evidence import Evaluated, log_evidence, screw_squares
from reframe_jax.model.features import Features
from reframe_jax.model.moments import Moments
from reframe_jax.model.rows import Forms, in_body
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
    varies: Array  # (2, 1, N) bool, whether positions and rotations vary along all axes
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

    The paths (3, 3, S, 5, N), m^2, are moments of the translations in ``PATHS`` at the origins (3, 4, N), m,
    of the linear types. The other arguments are those of :func:`.compare_windows`, the weights (N, S) of the
    scales in an amplitude, and the axes a and b (2, 3, N) of the universal joint.
    """
    rotations = jnp.moveaxis(features.to_rotation[:, :, z.TURN_GROUND], 0, -1).transpose(1, 2, 0, 3)
    levers = _squared_levers(features, rotations, origins)
    turns = jnp.moveaxis(moments.products[:, 0, z.TURN_BODY, z.TURN_BODY], 0, -1)
    noise, varies = _limited_noise(paths[:, :, 0], turns, levers, moments.details[:, 0], noise.T)
    return WindowStatistics(
        spectra=Spectra(*(s[:, None] for s in (moments.details.T, scale_weight.T, moments.white.T, noise))),
        mean=jnp.moveaxis(features.mean_rotation, 0, -1),
        rotations=rotations,
        levers=levers,
        varies=varies[:, None],
        universal=_universal_moments(universal_axes[0], universal_axes[1], moments.products, features),
    )


def evaluate_entries(forms: Forms, at: Unknowns, entries: Table, windows: WindowStatistics) -> Evaluated:
    """Compute the amplitudes and the log evidence (entries, N) of entries: rows of the table at parameters.

    The forms are the moments about the origins, with the axes (entries, N) last.
    """
    universal, crossed, spectra = windows.universal, entries.crossed, windows.spectra
    sine = total(universal.sine, 0)[None] / len(universal.sine)
    lever = pick(windows.levers, entries.path, 2)
    crossed_form = universal.form[:, :, :, None]
    compute = in_registers(amplitudes_of, 2)
    amplitudes = compute(materialize(forms), crossed_form, at, entries, lever, sine, spectra)
    # ---- derivative of the coordinates with respect to the pose
    axis = times(windows.mean[:, :, None], times(at.frame, tilted_axis(at.tilt)))
    along = total(windows.rotations[:, :, :, None] * at.frame[None, :, 2, None], 1)
    cosine = total(along * axis[:, None], 0)
    det = jnp.where(entries.apart & in_body(entries), jnp.abs(cosine), 1.0)
    det = jnp.where(crossed, universal.sine[:, None], det)
    consistency = total(jnp.log(det + 1e-6), 0) / len(det)
    tilt = jnp.where(entries.tied, jnp.sqrt(total(at.tilt**2, 0) + jnp.finfo(det.dtype).tiny), 0)
    evidence = log_evidence(amplitudes, tilt, entries, spectra.noise, windows.varies)
    # entries whose evidence is not a number, for example where nothing moves, are improbable
    evidence = jnp.where(jnp.isnan(evidence), -jnp.inf, evidence)
    numbers = amplitudes.independent, amplitudes.log_variance
    return Evaluated(evidence, consistency, screw_squares(amplitudes), *numbers)


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


def _limited_noise(
    paths: Array, turns: Array, levers: Array, details: Array, noise: Array
) -> tuple[Array, Array]:
    """White noise (2, N), m and rad, of positions and rotations: no more than the axes of least motion show.

    The least variance along any axis is at most 3 / tr(C^-1) for the covariance C. A part of it, at most the
    noise of rotations times the squared lever, comes from rotations. The moments of the differences of
    consecutive poses are ``paths`` (3, 3, 5, N), m^2, for every translation, and ``turns`` (3, 3, N), rad^2;
    ``details`` (N,) is their number, 0 if the poses have no order. The second result, (2, N) bool, is whether
    positions and rotations vary along all axes.
    """
    forms = jnp.concatenate([paths, turns[:, :, None]], axis=2)
    unit = jnp.broadcast_to(unit_matrix(forms.dtype, 2), turns[:, :, None].shape)
    inverse, _ = invert_symmetric([forms[i, j] for i, j in INDEX_PAIRS])
    of_rotation = total(inverse * jnp.concatenate([levers, unit], axis=2), 0, 1)
    of_position = jnp.concatenate([trace(inverse[:, :, :-1]), jnp.zeros_like(of_rotation[-1:])])
    varies = 3 / trace(inverse) > _CONSTANT  # a planar tracker, for example, does not measure all directions
    shown = jnp.max(jnp.where(varies, jnp.stack([of_position, of_rotation]), 0), axis=1)
    # the differences have twice the variance of the noise
    limited = jnp.where(details > 0, jnp.minimum(noise, jnp.sqrt(3 / (2 * shown) + 1e-16)), noise)
    return limited, varies[-2:]
