"""Compute the probability of every entry of the table from the features of windows.

The search finds the origin of the lowest norm of every frame type. *Screening* evaluates every entry at its
starting parameters; the most probable entries are then fitted and evaluated again. Arrays inside this module
have components first, then scales, entries and windows.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.kernel import in_registers
from reframe_jax.geometry.small import count_independent, materialize, pick, sandwich, times, total
from reframe_jax.model import features as z
from reframe_jax.model.evaluation import WindowStatistics, evaluate_entries, window_statistics
from reframe_jax.model.evidence import Evaluated, compare
from reframe_jax.model.features import Features
from reframe_jax.model.fit import ASSUMED_STEPS, STEPS, Parameters
from reframe_jax.model.moments import Moments
from reframe_jax.model.rows import Forms, crossed_frame, entry_moments, in_body, problem_of
from reframe_jax.model.search import lowest_origins, norm_at, polynomials, unexplained_covariance
from reframe_jax.model.starts import Axes, common_frames, entry_starts, universal_axes
from reframe_jax.model.steps import Unknowns, descend, path_of
from reframe_jax.model.table import ENTRIES, LINEAR_KINDS, ROWS, TABLE, Table, entries_at
from reframe_jax.tuning import EVIDENCE as C

Array = jax.Array
CANDIDATES = 7  # entries that are fitted; with poor starting parameters, the right one may rank only fifth
# entries whose held coordinates do not depend on a starting origin that two directions leave undetermined
_PLACED = np.array([len(entry.any_origin) != 2 for entry in ENTRIES])
# independent components of a twist under entries with three free rotations; 0 for others
_COMPONENTS = np.array([sum(entry.dof) * (entry.dof[0] == 3) for entry in ENTRIES], np.int32)
_EVERY = Table(*(np.moveaxis(leaf, 0, -1)[..., None] for leaf in TABLE))  # entries (..., E, 1) as in problems


class ScaleWeights(NamedTuple):
    """Weights of the scales of N windows; 0 at scales that are not used."""

    search: Array  # (N, S) n_s in sums over scales, in the search and in the fit; see :meth:`.Moments.using`
    amplitude: Array  # (N, S) weights in a variance over the recording, at the scales of the default


class Searched(NamedTuple):
    """Result of the search for N windows.

    Attributes:
        origins: (N, 4, 3) m, origin with the lowest norm for every linear type.
        norm: (N, 4) F at these origins.
        linear_axes: (N, 4, 3, 3) common axes of every linear type, by ascending amplitude.
        angular_axes: (N, 2, 3, 3) common axes of the rotation in ground and body, by ascending amplitude.
        starts: starting parameters of every entry, with axes (N, E) in front.
        tilt_scale: (N,) rad, size of the tilt in the fit.
        universal: (N, 2, 3) axes of a universal joint: a of the ground and b of the body.
    """

    origins: Array
    norm: Array
    linear_axes: Array
    angular_axes: Array
    starts: Parameters
    tilt_scale: Array
    universal: Array


class Compared(NamedTuple):
    """Result of the comparison of entries for N windows.

    Attributes:
        log_probability: (N, E) of every entry; entries that were not fitted have their starting parameters.
        chosen: (N, C) codes of the fitted entries, -1 where too few are allowed, and of the exact ones.
        parameters: of the C chosen entries, with axes (N, C) in front.
    """

    log_probability: Array
    chosen: Array
    parameters: Parameters


def choose_scales(moments: Moments, noise: Array, scales: Array) -> ScaleWeights:
    """Choose the scales: by default the smooth part, and all at which the motion exceeds the noise.

    The noise (N, 2), m and rad, is the white noise of every component of a pose; ``scales`` () int, the sum
    of the block widths to use, in samples, is 0 or less for the default.
    """
    last = moments.details.shape[1] - 1
    index, firsts = jnp.arange(last + 1), []
    for group, rows in enumerate((z.POSITION, z.TURN_BODY)):
        size = jnp.trace(moments.products[:, :, rows, rows], axis1=2, axis2=3)
        level = 3 * jnp.square(C.above_noise * noise[:, group, None]) * moments.white
        above = (size > level) & (moments.details > 0)
        # beyond all scales for a group (positions or rotations) that never exceeds its noise
        firsts.append(jnp.min(jnp.where(above, index, 2 * last + C.late), axis=1))
    low, high = jnp.minimum(*firsts), jnp.maximum(*firsts)
    # a group that exceeds its noise much later than the other one only drifts
    first = jnp.where(low > last, 0, jnp.where(high > low + C.late, low, high))
    keep = index >= first[:, None]
    # the last details and the smooth part always count
    details = jnp.sum(moments.details[:, :-1] > 0, axis=1)
    keep = keep | (index >= details[:, None] - 1)
    asked = ((moments.width.astype(jnp.int32) & scales) > 0) & (index < last)
    search = moments.using(jnp.where(scales > 0, asked, keep)).details
    return ScaleWeights(search, moments.scale_weight * keep)


def search_windows(features: Features, used: Moments, box: Array, origins: Array | None) -> Searched:
    """Search the origins of the linear types, and the starting parameters of the entries of the table.

    The moments have the weights of the scales in the search and in the fit, and ``box`` (N,), m, is half the
    width of the cube in which origins lie. Origins (N, 4, 3), m, are those of another search.
    """
    products = jnp.moveaxis(used.products, (0, 1), (3, 2))
    details, used_weight = used.details.T, used.scale_weight.T
    all_scales = total(products * used_weight, 2)
    coefficients = polynomials(products, ROWS[LINEAR_KINDS])
    if origins is None:
        unexplained = unexplained_covariance(all_scales, ROWS[LINEAR_KINDS])
        place, norm = lowest_origins(coefficients, details, box, unexplained)
    else:
        place = jnp.moveaxis(origins, (0, 1), (2, 1))
        norm = norm_at(coefficients, details, place)
    mean = jnp.moveaxis(features.mean_rotation, 0, -1)
    _, paths = path_of(entry_moments(products, mean).paths[..., : len(LinearType), :], place)
    turns = jnp.stack([products[r, r] for r in (z.TURN_GROUND, z.TURN_BODY)], axis=3)
    axes = common_frames(paths, turns, products[z.POSITION, z.POSITION], details, used_weight)
    crossed = universal_axes(axes, products, details, jnp.moveaxis(features.mean_matrix, 0, -1))
    starts = entry_starts(place, axes, all_scales, mean)
    return Searched(
        origins=_windows_first(place),
        norm=norm.T,
        linear_axes=_windows_first(axes.linear),
        angular_axes=_windows_first(axes.angular),
        starts=_start_parameters(starts, mean),
        tilt_scale=_tilt_scale(axes, all_scales),
        universal=jnp.moveaxis(jnp.stack(crossed), -1, 0),
    )


class _Round(NamedTuple):
    """C entries of every window: codes (C, N), unknowns, and results of :func:`.evaluate_entries`."""

    codes: Array
    at: Unknowns
    values: Evaluated


def compare_windows(
    features: Features,
    moments: Moments,
    weights: ScaleWeights,
    noise: Array,
    box: Array,
    searched: Searched,
    allowed: Array,
) -> Compared:
    """Fit and compare the entries of N windows.

    The moments are those of all scales, ``noise`` (N, 2), m and rad, is the white noise of every component of
    a pose, ``box`` (N,), m, is half the width of the cube in which origins lie, and ``allowed`` (E,) bool has
    the entries that may be chosen.
    """
    products = jnp.moveaxis(moments.products, (0, 1), (3, 2))
    mean = jnp.moveaxis(features.mean_rotation, 0, -1)
    place = jnp.moveaxis(searched.origins, (0, 1), (2, 1))
    moments_of_paths = entry_moments(products, mean)
    at_origins = moments_of_paths.at(jnp.pad(place, ((0, 0), (0, 1), (0, 0))))  # the position has no origin
    crossed = jnp.moveaxis(searched.universal, 0, -1)
    windows = window_statistics(features, moments, weights.amplitude, at_origins.path, noise, place, crossed)
    starts = Unknowns(*(jnp.moveaxis(leaf, (0, 1), (-1, -2)) for leaf in searched.starts))
    turned = times(mean[:, :, None], starts.frame)
    starts = starts._replace(frame=jnp.where(in_body(TABLE)[:, None], starts.frame, turned))
    details, number = weights.search.T, len(ENTRIES)
    # entries without parameters, such as "fixed", are exact from the start
    exact = np.flatnonzero(TABLE.parameters == 0).astype(np.int32)
    fittable = allowed & (TABLE.parameters > 0)
    steps = jnp.where(jnp.all(allowed), STEPS, ASSUMED_STEPS)
    blocks = -(-number // CANDIDATES)
    codes = jnp.asarray(np.resize(np.arange(number, dtype=np.int32), (blocks, CANDIDATES)))

    def screen(r: Array, _: _Round) -> tuple[Array, Forms, Unknowns]:
        """Return the next block of entries, at their starting parameters."""
        block = codes[r]
        paths = jnp.asarray(TABLE.path)[block]
        start = jax.tree.map(lambda leaf: jnp.take(leaf, block, axis=-2, mode="clip"), starts)
        forms = jax.tree.map(lambda leaf: jnp.take(leaf, paths, axis=-2, mode="clip"), at_origins)
        return jnp.broadcast_to(block[:, None], (CANDIDATES, details.shape[1])), forms, start

    def fit(_: Array, rounds: _Round) -> tuple[Array, Forms, Unknowns]:
        """Fit the entries that are most probable at their starting parameters."""
        screened: _Round = jax.tree.map(lambda leaf: _flat(leaf[:blocks])[..., :number, :], rounds)
        rank = jnp.where(fittable[:, None], log_probability(screened, _EVERY, _PLACED), -jnp.inf)
        best = jax.lax.top_k(rank.T, CANDIDATES)[1].T
        entries = entries_at(best)
        start = jax.tree.map(lambda leaf: pick(leaf, best, -2), starts)
        of_entries = moments_of_paths.pick(entries.path)
        limits = searched.tilt_scale[None], box[None]
        fitted = problem_of(of_entries, details[:, None], entries, *limits, entries.tied)
        at = in_registers(descend, 2)(fitted, start, steps)
        return best, of_entries.at(at.origin), at

    def log_probability(entries: _Round, table: Table, standard: np.ndarray) -> Array:
        return compare(entries.values, entries.at.pitch, table, standard)

    def evaluate(codes: Array, forms: Forms, at: Unknowns) -> _Round:
        return _Round(codes, at, evaluate_entries(forms, at, entries_at(codes), windows))

    def next_round(r: Array, rounds: _Round) -> _Round:
        """Screen a block of entries in every round but the last, which fits the most probable entries."""
        found = evaluate(*jax.lax.cond(r < blocks, screen, fit, r, rounds))
        put = partial(jax.lax.dynamic_update_index_in_dim, index=r, axis=0, allow_negative_indices=False)
        return jax.tree.map(put, rounds, found)

    first = jax.eval_shape(lambda: evaluate(*screen(jnp.int32(0), None)))  # type: ignore[arg-type]
    rounds = jax.tree.map(lambda leaf: jnp.zeros((blocks + 1, *leaf.shape), leaf.dtype), first)
    rounds = jax.lax.fori_loop(0, blocks + 1, next_round, rounds)
    # entries that were not fitted keep their evidence from screening
    screened = jax.tree.map(lambda leaf: _flat(leaf[:blocks])[..., :number, :], rounds)
    fitted: _Round = jax.tree.map(lambda leaf: leaf[blocks], rounds)
    chosen = jnp.take(fittable, fitted.codes, mode="clip")
    fitted = _without(fitted, ~chosen)._replace(codes=jnp.where(chosen, fitted.codes, -1))
    same = screened.codes[:, None] == fitted.codes[None]  # (E, C, N)
    screened = _without(screened, jnp.any(same, axis=1))
    both = materialize(jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=-2), screened, fitted))
    # an entry with its starting parameters is no standard, unless it has none
    final = np.append(TABLE.parameters == 0, np.ones(CANDIDATES, bool))
    table = entries_at(both.codes)
    values = log_probability(both, table, final)
    best = pick(both.codes, jnp.argmax(values, axis=0)[None], 0)[0]
    # what may hold by chance is less certain: every missing motion halves the log odds
    types = jnp.where(jnp.any(table.held, axis=0), 0, np.log(len(LinearType)))  # of an unconstrained motion
    values = (values + types) * 0.5 ** _missing_motions(products, weights.amplitude, best) - types
    values = values - jax.nn.logsumexp(values, axis=0)
    everywhere = jnp.max(jnp.where(same, values[None, number:], values[:number, None]), axis=1)
    others = jnp.broadcast_to(jnp.where(allowed[exact], exact, -1)[:, None], (len(exact), details.shape[1]))
    codes = jnp.concatenate([fitted.codes, others])
    at = jax.tree.map(lambda a, b: jnp.concatenate([a, b[..., exact, :]], axis=-2), fitted.at, starts)
    parameters = _parameters(at, codes, windows)
    return Compared(everywhere.T, codes.T, parameters)


def _missing_motions(products: Array, scale_weight: Array, codes: Array) -> Array:
    """Number (N,) of independent motions that N bodies lack to test entries with three free rotations.

    If n translations are held, the twist has 6 - n independent components. A slow or short motion has fewer
    that exceed slow errors, one standard deviation above their median, and obeys constraints by chance.
    """
    unit = jnp.asarray(np.repeat([C.lever, 1], 3)[:, None, None], products.dtype)
    forms = [products[a : a + 6, a : a + 6] for a in (z.TURN_BODY.start, z.TURN_GROUND.start)]
    whole = jnp.einsum("fgbsn,ns->fgbn", jnp.stack(forms, axis=2), scale_weight) * unit * unit[:, None]
    error = (np.exp(C.error_spread) * C.error_position) ** 2
    seen = jnp.min(count_independent(whole, jnp.full(whole.shape[1:], error, whole.dtype)), axis=0)
    return jnp.maximum(jnp.asarray(_COMPONENTS)[codes] - seen, 0)


def _without(entries: _Round, gone: Array) -> _Round:
    """Make some entries impossible."""
    evidence = jnp.where(gone, -jnp.inf, entries.values.evidence)
    return entries._replace(values=entries.values._replace(evidence=evidence))


def _flat(leaf: Array) -> Array:
    """Reshape (blocks, ..., C, N) to (..., blocks * C, N)."""
    moved = jnp.moveaxis(leaf, 0, -3)
    return moved.reshape(*moved.shape[:-3], -1, moved.shape[-1])


def _windows_first(leaf: Array) -> Array:
    """Transpose (components, entries, N) to (N, entries, components)."""
    return jnp.moveaxis(leaf, (-1, -2), (0, 1))


def _start_parameters(at: Unknowns, mean: Array) -> Parameters:
    """Parameters (N, E, ...) of the starts of all entries but universal joints."""
    turned = times(jnp.swapaxes(mean[:, :, None], 0, 1), at.frame)
    axes = jnp.where(in_body(TABLE)[:, None], at.frame, turned)
    return Parameters(*(_windows_first(leaf) for leaf in (axes, at.origin, at.tilt, at.pitch)))


def _parameters(at: Unknowns, codes: Array, windows: WindowStatistics) -> Parameters:
    """Parameters (N, entries, ...) from unknowns, which are given in axes of the main body."""
    universal, mean = windows.universal, windows.mean[:, :, None]
    inside, crossed = (jnp.asarray(flags)[codes] for flags in (in_body(TABLE), TABLE.crossed))
    axes = jnp.where(inside, at.frame, times(jnp.swapaxes(mean, 0, 1), at.frame))
    cross_axes, cross_tilt = crossed_frame(universal.ground, universal.body, windows.mean)
    axes = jnp.where(crossed, cross_axes[:, :, None], axes)
    tilt = jnp.where(crossed, cross_tilt[:, None], at.tilt)
    return Parameters(*(_windows_first(leaf) for leaf in (axes, at.origin, tilt, at.pitch)))


def _tilt_scale(axes: Axes, whole: Array) -> Array:
    """Size (N,), rad, of the tilt in the fit: RMS rotation across the axis of the largest rotation."""
    across = sandwich(axes.angular[:, :, 1], whole[z.TURN_BODY, z.TURN_BODY][:, :, None])[:2, :2, 0]
    trace = across[0, 0] + across[1, 1]
    det = across[0, 0] * across[1, 1] - across[0, 1] * across[1, 0]
    return jnp.sqrt(jnp.maximum(trace - det / jnp.maximum(trace, 1e-30), 0) + 1e-12)
