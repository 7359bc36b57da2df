"""From features to the probability of every entry of the table, for windows that have been checked."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import AngularType, LinearType
from reframe_jax.model import features as z
from reframe_jax.model.axes import common_axes, principal_axes, sort_axes
from reframe_jax.model.constants import SCALES
from reframe_jax.model.evidence import Amplitudes, Spectra, entry_amplitudes, log_evidence, log_posterior
from reframe_jax.model.features import Features
from reframe_jax.model.fit import Data, Parameters, coordinates, fit_entry
from reframe_jax.model.moments import Moments
from reframe_jax.model.search import lowest_origins, norm_at, polynomials, unexplained_covariance
from reframe_jax.model.table import ENTRIES, KINDS, ROWS, TABLE, Table

__all__ = ["Solved", "choose_scales", "solve_windows"]

Array = jax.Array
CANDIDATES = 8
_LINEAR = np.array([KINDS.index(t.name) for t in LinearType])


class Solved(NamedTuple):
    """What is found about N windows.

    Attributes:
        log_probability: (N, E) of every entry; -inf for those that were not fitted.
        parameters: of the C entries that were fitted, with axes (N, C) in front.
        amplitudes: of their coordinates, with axes (N, C) in front.
        origins: (N, 4, 3) m, of the lowest norm of every linear type; norm: (N, 4) F there.
        linear_axes: (N, 4, 3, 3) and angular_axes (N, 2, 3, 3): common axes, by amplitude, ascending.
        starts: of every entry, with axes (N, E) in front.
        chosen: (N, C) codes of the entries that were fitted.
        tilt_scale: (N,) rad, size of the tilt in the fit.
    """

    log_probability: Array
    parameters: Parameters
    amplitudes: Amplitudes
    origins: Array
    norm: Array
    linear_axes: Array
    angular_axes: Array
    starts: Parameters
    chosen: Array
    tilt_scale: Array


def choose_scales(moments: Moments, noise: Array, scales: tuple[int, ...] | None) -> Moments:
    """Leave out the details of scales that are not used.

    Args:
        moments: of N windows, of all scales.
        noise: (N, 2) m and rad, of every component.
        scales: in samples; None for the smooth part and all at which the motion stands out of the noise.
    """
    last = moments.details.shape[1] - 1
    index = jnp.arange(last + 1)
    if scales is not None:
        asked = jnp.isin(moments.width, jnp.asarray(scales, moments.width.dtype)) & (index < last)
        return moments._replace(details=jnp.where(asked, moments.details, 0))
    keep = jnp.ones_like(moments.details, bool)
    for group, rows in enumerate((z.POSITION, z.TURN_BODY)):
        size = jnp.trace(moments.products[:, :, rows, rows], axis1=2, axis2=3)
        level = 3 * jnp.square(SCALES.above_noise * noise[:, group, None]) * moments.white
        above = (size > level) & (moments.details > 0)
        # a group that never stands out of the noise does not count
        first = jnp.where(jnp.any(above, axis=1), jnp.argmax(above, axis=1), 0)
        keep = keep & (index >= first[:, None])
    # the last details and the smooth part always count
    details = jnp.sum(moments.details[:, :-1] > 0, axis=1)
    keep = keep | (index >= details[:, None] - 1)
    return moments._replace(details=jnp.where(keep, moments.details, 0))


def solve_windows(
    features: Features,
    moments: Moments,
    used: Moments,
    noise: Array,
    box: Array,
    origins: Array | None = None,
    assume: tuple[int, ...] | None = None,
) -> Solved:
    """Search, fit and compare entries of the table.

    Args:
        features: of N windows.
        moments: of all scales; ``used``: with details only at those that are used.
        noise: (N, 2) m and rad.
        box: (N,) m, half the width of the cube in which origins lie.
        origins: (N, 4, 3) m, of every linear type, from another search; None to search over scales.
        assume: codes of the entries that are compared; None for all.
    """
    coefficients = polynomials(used.products, ROWS[_LINEAR])
    if origins is None:
        total = jnp.einsum("ns,nsfg->nfg", used.share, used.products)
        unexplained = unexplained_covariance(total, ROWS[_LINEAR])
        origins, norm = lowest_origins(coefficients, used.details, box, unexplained)
    else:
        norm = norm_at(coefficients, used.details, origins)
    solve = partial(_solve_window, assume=assume)
    return jax.vmap(solve)(features, moments, used, noise, box, origins, norm)


def _sorted_axes(rows: Array, products: Array, details: Array, share: Array) -> Array:
    """Common axes of three coordinates (3, 27), by amplitude, ascending and right-handed."""
    covariances = jnp.einsum("if,sfg,jg->sij", rows, products, rows)
    axes = common_axes(covariances + 1e-18 * jnp.eye(3, dtype=covariances.dtype), details)
    return sort_axes(axes, jnp.einsum("s,sij->ij", share, covariances))[0]


def _solve_window(
    features: Features,
    moments: Moments,
    used: Moments,
    noise: Array,
    box: Array,
    origins: Array,
    norm: Array,
    assume: tuple[int, ...] | None,
) -> Solved:
    products, details = used.products, used.details
    share, white = _weights(used)
    rows = jnp.asarray(ROWS, products.dtype)
    of_axes = partial(_sorted_axes, products=products, details=details, share=share)
    points = jnp.concatenate([jnp.ones((4, 1), products.dtype), origins], axis=1)
    linear = jax.vmap(of_axes)(jnp.einsum("tiaf,ta->tif", rows[_LINEAR], points))
    turns = rows[np.array([KINDS.index("turn in ground"), KINDS.index("turn in body")]), :, 0]
    angular = jax.vmap(of_axes)(turns)
    mean = features.mean_rotation
    starts = _starts(origins, linear, angular, mean, products, details, share)
    data = Data(products, details, mean, box)
    total = jnp.einsum("s,sfg->fg", share, products)
    across = angular[AngularType.B][:, :2].T @ turns[AngularType.B]
    held = across @ total @ across.T
    scale = jnp.sqrt(jnp.maximum(jnp.trace(held) - jnp.linalg.det(held) / jnp.trace(held), 0) + 1e-12)
    own = _own_noise(products, moments.details, white, noise)
    spectra = Spectra(
        products, details, moments.details, share, white, features.to_position, features.to_rotation, noise
    )
    table = jax.tree.map(jnp.asarray, TABLE)

    def judge(parameters: Parameters, entry: Table) -> tuple[Amplitudes, Array]:
        of = entry_amplitudes(coordinates(parameters, mean, entry), entry, spectra)
        tilt = jnp.where(entry.tied, jnp.linalg.norm(parameters.tilt), 0)
        return of, log_evidence(of, tilt, entry, own)

    amplitudes, evidence = jax.vmap(judge)(starts, table)
    before = log_posterior(evidence, amplitudes, starts.pitch, table, details)
    if assume is not None:
        allowed = np.isin(np.arange(len(ENTRIES)), assume)
        before = jnp.where(allowed, before, -jnp.inf)
    chosen = jax.lax.top_k(before, CANDIDATES if assume is None else min(CANDIDATES, len(assume)))[1]
    start, entries = jax.tree.map(lambda leaf: leaf[chosen], (starts, table))
    parameters, _ = jax.vmap(lambda s, e: fit_entry(s, data, e, scale, e.tied))(start, entries)
    amplitudes, evidence = jax.vmap(judge)(parameters, entries)
    posterior = log_posterior(evidence, amplitudes, parameters.pitch, entries, details)
    everywhere = jnp.full(before.shape, -jnp.inf).at[chosen].set(posterior)
    return Solved(everywhere, parameters, amplitudes, origins, norm, linear, angular, starts, chosen, scale)


def _weights(used: Moments) -> tuple[Array, Array]:
    """``share`` and ``white`` of the moments of one window."""
    last = np.arange(used.width.shape[0]) == used.width.shape[0] - 1
    share = jnp.where(last, 1.0, 0.25).astype(used.products.dtype) * (used.details > 0)
    return share, jnp.where(last, 1.0, 2.0) / used.width


def _own_noise(products: Array, all_details: Array, white: Array, noise: Array) -> Array:
    """White noise, (2,) m and rad, no more than any scale shows along its stillest axis."""
    shown = []
    for rows in (z.POSITION, z.TURN_BODY):
        smallest = jax.vmap(lambda c: principal_axes(c)[1][0])(products[:-1, rows, rows])
        shown.append(jnp.min(jnp.where(all_details[:-1] > 0, smallest / white[:-1], jnp.inf)))
    return jnp.minimum(noise, jnp.sqrt(jnp.maximum(jnp.stack(shown), 1e-16)))


def _frames(axis: Array, across: Array) -> Array:
    """Rotations (..., 3, 3) whose last column is the axis, and whose first is nearest to ``across``."""
    first = across - axis * jnp.sum(axis * across, axis=-1, keepdims=True)
    first = first / jnp.sqrt(jnp.sum(first * first, axis=-1, keepdims=True) + 1e-30)
    return jnp.stack([first, jnp.cross(axis, first), axis], axis=-1)


def _starts(
    origins: Array, linear: Array, angular: Array, mean: Array, products: Array, details: Array, share: Array
) -> Parameters:
    """Where the fit of every entry starts."""
    total = jnp.einsum("s,sfg->fg", share, products)
    main = angular[AngularType.B][:, 2]
    path = principal_axes(total[z.POSITION, z.POSITION])[0]
    first, second = _crossed_axes(angular, mean, products, details)
    kinds = np.array([entry.kind for entry in ENTRIES])
    own = linear[kinds]
    fixed = np.array([[entry.kind.name[0] == "G"] for entry in ENTRIES])
    # entries whose rotations are held are written with the position, in the ground
    turn = jnp.where(fixed, mean @ main, main)
    choices = {"turn": turn, "cross": first, "normal": own[:, :, 0], "along": own[:, :, 2]}
    choices |= {"path": path[:, 2], "lift": path[:, 0]}
    names = list(choices)
    every = jnp.stack([jnp.broadcast_to(choices[name], turn.shape) for name in names])
    which = np.array([names.index(entry.start) for entry in ENTRIES])
    axis = every[which, np.arange(len(ENTRIES))]
    # of the axes of the type, the stillest that is not nearly along the axis
    sine = jnp.sqrt(jnp.maximum(1 - jnp.square(jnp.einsum("ea,eai->ei", axis, own)), 0))
    across = jnp.take_along_axis(own, jnp.argmax(sine > 0.6, axis=1)[:, None, None], axis=2)[:, :, 0]
    across = jnp.where(TABLE.crossed[:, None], mean @ second, across)
    frames = _frames(axis, across)
    frames = jnp.where(fixed[:, :, None], jnp.einsum("ji,ejk->eik", mean, frames), frames)
    turns, slides = frames[:, :, 2], jnp.einsum("ij,ej->ei", mean, frames[:, :, 2])
    both = jnp.einsum("ei,ij,ej->e", slides, total[z.POSITION, z.TURN_BODY], turns)
    pitch = both / (jnp.einsum("ei,ij,ej->e", turns, total[z.TURN_BODY, z.TURN_BODY], turns) + 1e-30)
    tilt = jnp.zeros((len(ENTRIES), 2), origins.dtype)
    return Parameters(frames, origins[kinds], tilt, jnp.where(TABLE.pitch, pitch, 0))


def _crossed_axes(angular: Array, mean: Array, products: Array, details: Array) -> tuple[Array, Array]:
    """Axes a of the ground and b of the body whose angle changes least: a' R b, by turns."""
    second = products[:, z.ROTATION, z.ROTATION].reshape(-1, 3, 3, 3, 3)

    def improve(pair: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        a, b = pair
        for _turn in range(2):
            spread = jnp.einsum("siajb,a,b->sij", second, b, b)
            size = jnp.einsum("sij,i,j->s", spread, a, a) + 1e-18
            form = jnp.einsum("s,sij->ij", details / size, spread)
            # axes along each other hold their angle in any motion about that axis
            along = mean @ b
            form = form + jnp.sum(details) * 30 * jnp.outer(along, along)
            a = principal_axes(form)[0][:, 0]
            spread = jnp.einsum("siajb,i,j->sab", second, a, a)
            size = jnp.einsum("sab,a,b->s", spread, b, b) + 1e-18
            form = jnp.einsum("s,sab->ab", details / size, spread)
            along = mean.T @ a
            form = form + jnp.sum(details) * 30 * jnp.outer(along, along)
            b = principal_axes(form)[0][:, 0]
        return (a, b), None

    def of_start(a: Array, b: Array) -> tuple[Array, Array, Array]:
        (a, b), _ = jax.lax.scan(improve, (a, b), None, length=3)
        size = jnp.einsum("siajb,i,a,j,b->s", second, a, b, a, b)
        return a, b, jnp.sum(details * jnp.log(size + 1e-18))

    ground, body = angular[AngularType.G], angular[AngularType.B]
    a, b, value = jax.vmap(of_start)(ground.T[jnp.array([2, 1])], body.T[jnp.array([1, 2])])
    best = jnp.argmin(value)
    return a[best], b[best]
