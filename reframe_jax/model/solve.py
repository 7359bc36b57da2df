"""From features to the probability of every entry of the table, for windows that have been checked.

A first look judges all entries at their starts; those that look best are fitted and judged again. Within,
arrays have components first, then scales, entries and windows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.constraints.types import LinearType
from reframe_jax.geometry.small import largest, materialize, sandwich, times, total
from reframe_jax.model import features as z
from reframe_jax.model.constants import SCALES
from reframe_jax.model.evidence import Amplitudes, Coordinates, Spectra, amplitudes_of, compare, log_evidence
from reframe_jax.model.features import Features
from reframe_jax.model.fit import LAST_STEPS, STEPS, Parameters
from reframe_jax.model.moments import Moments
from reframe_jax.model.rows import (
    Forms,
    coordinates_at,
    crossed_frame,
    entry_moments,
    in_body,
    problem_of,
)
from reframe_jax.model.search import lowest_origins, norm_at, polynomials, unexplained_covariance
from reframe_jax.model.starts import Axes, common_frames, entry_starts, smallest_eigenvalue, universal_axes
from reframe_jax.model.steps import Unknowns, descend, tilted_axis
from reframe_jax.model.table import ENTRIES, KINDS, PATHS, ROWS, TABLE, Table, entries_at

__all__ = ["Solved", "choose_scales", "solve_windows"]

Array = jax.Array
CANDIDATES = 8  # entries that are fitted: a contact whose start is poor may look only the seventh best
_LINEAR = np.array([KINDS.index(t.name) for t in LinearType])


class Solved(NamedTuple):
    """What is found about N windows.

    Attributes:
        log_probability: (N, E) of every entry, those that were not fitted as the first look found them.
        parameters: of the C entries that were fitted, with axes (N, C) in front; their tilt is free.
        origins: (N, 4, 3) m, of the lowest norm of every linear type; norm: (N, 4) F there.
        linear_axes: (N, 4, 3, 3) and angular_axes (N, 2, 3, 3): common axes, by amplitude, ascending.
        starts: of every entry, with axes (N, E) in front.
        chosen: (N, C) codes of the entries that were fitted.
        tilt_scale: (N,) rad, size of the tilt in the fit.

    Without a comparison of entries, their probabilities are NaN, and what was fitted is None.
    """

    log_probability: Array
    parameters: Parameters | None
    origins: Array
    norm: Array
    linear_axes: Array
    angular_axes: Array
    starts: Parameters
    chosen: Array | None
    tilt_scale: Array


def choose_scales(moments: Moments, noise: Array, scales: tuple[int, ...] | None) -> Moments:
    """Leave out the details of scales that are not used.

    Args:
        moments: of N windows, of all scales.
        noise: (N, 2) m and rad, of every component.
        scales: in samples; None for the smooth part and all at which the motion stands out of the noise, none
            for the smooth part alone.
    """
    last = moments.details.shape[1] - 1
    index = jnp.arange(last + 1)
    if scales:
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
    judge: bool = True,
) -> Solved:
    """Search, fit and compare entries of the table.

    Args:
        features: of N windows.
        moments: of all scales.
        used: the same, with details only at the scales that are used.
        noise: (N, 2) m and rad.
        box: (N,) m, half the width of the cube in which origins lie.
        origins: (N, 4, 3) m, of every linear type, from another search; None to search over scales.
        assume: codes of the entries that are fitted; None for the most probable ones.
        judge: whether entries are compared; else only their starts and the optima of the types are found.
    """
    products = materialize(jnp.moveaxis(used.products, (0, 1), (3, 2)))
    coefficients = polynomials(products, ROWS[_LINEAR])
    if origins is None:
        unexplained = unexplained_covariance(total(products * used.scale_weight.T, 2), ROWS[_LINEAR])
        place, norm = lowest_origins(coefficients, used.details.T, box, unexplained)
    else:
        place = jnp.moveaxis(origins, (0, 1), (2, 1))
        norm = norm_at(coefficients, used.details.T, place)
    return _compare(features, moments, used, products, noise, box, place, norm, assume, judge)


class _Windows(NamedTuple):
    """What the judgement of entries needs of N windows, with the windows last.

    Attributes:
        spectra: with (S, 1, N).
        mean: (3, 3, N) mean rotation.
        own: (2, 1, N) m and rad, noise that errors grow with.
        turned: (3, 3, M, N) rotations of a few poses.
        levers: (3, 3, 5, N) squared sensitivity to a rotation of the translations of every path.
        joint: moments of the coordinates of a universal joint.
    """

    spectra: Spectra
    mean: Array
    own: Array
    turned: Array
    levers: Array
    joint: "_Joint"


class _Joint(NamedTuple):
    """Rotations of universal joints: their angle, and the turns about the axes a (3, N) and b (3, N).

    Attributes:
        ground: a.
        body: b.
        form: (3, 3, S, N) moments.
        mixed: (3, 3, 4, 2, S, N) moments with the paths of GB and BG, directions times (1, origin).
        sine: (M, N) 1 - cos^2 of the angle.
    """

    ground: Array
    body: Array
    form: Array
    mixed: Array
    sine: Array


def _compare(
    features: Features,
    moments: Moments,
    used: Moments,
    products: Array,
    noise: Array,
    box: Array,
    place: Array,
    norm: Array,
    assume: tuple[int, ...] | None,
    judge: bool,
) -> Solved:
    details, all_details = used.details.T, moments.details.T
    scale_weight, white = used.scale_weight.T, used.white.T
    mean = jnp.moveaxis(features.mean_rotation, 0, -1)
    origins, norm = _first(place), norm.T
    each = entry_moments(products, mean)
    about = each.at(jnp.pad(place, ((0, 0), (0, 1), (0, 0))))  # the position has no origin
    paths = about.path[:, :, :, : len(LinearType)]
    turns = jnp.stack([products[r, r] for r in (z.TURN_GROUND, z.TURN_BODY)], axis=3)
    axes = common_frames(paths, turns, products[z.POSITION, z.POSITION], details, scale_weight)
    whole = total(products * scale_weight, 2)
    a, b = universal_axes(axes, products, details, mean)
    joint = _joint(a, b, used.products, features)
    starts = entry_starts(place, axes, (a, b), whole, mean)
    scale = _tilt_scale(axes, whole)
    if not judge:
        never = jnp.full((origins.shape[0], len(ENTRIES)), jnp.nan, origins.dtype)
        frames = _first(axes.linear), _first(axes.angular)
        every_start = _start_parameters(starts, mean)
        return Solved(never, None, origins, norm, *frames, every_start, None, scale)
    per_window = details, all_details, scale_weight, white, noise.T
    spectra = Spectra(*(leaf[:, None] for leaf in per_window))
    own = _own_noise(products, all_details, white, noise)
    turned = jnp.moveaxis(features.to_rotation[:, :, z.TURN_GROUND], 0, -1).transpose(1, 2, 0, 3)
    of = _Windows(spectra, mean, own[:, None], turned, _levers(features, turned, place), joint)
    number = len(ENTRIES)
    assumed = np.isin(np.arange(number), np.arange(number) if assume is None else assume)[:, None]
    size = CANDIDATES if assume is None else min(CANDIDATES, len(assume))
    blocks = -(-number // size)
    codes = jnp.asarray(np.resize(np.arange(number, dtype=np.int32), (blocks, size)))

    def look(r: Array, _: _Block) -> tuple[Array, Forms, Unknowns, Unknowns]:
        """The next entries, at their starts."""
        mine = codes[r]
        kinds = jnp.asarray(TABLE.path)[mine]
        start = jax.tree.map(lambda leaf: jnp.take(leaf, mine, axis=-2), starts)
        forms = jax.tree.map(lambda leaf: jnp.take(leaf, kinds, axis=-2), about)
        return jnp.broadcast_to(mine[:, None], (size, details.shape[1])), forms, start, start

    def fit(_: Array, rounds: _Block) -> tuple[Array, Forms, Unknowns, Unknowns]:
        """The entries that look best, fitted; then with the tilt free."""
        looks: _Block = jax.tree.map(lambda leaf: _flat(leaf[:blocks])[..., :number, :], rounds)
        best = jax.lax.top_k(jnp.where(assumed, posterior_of(looks)[0], -jnp.inf).T, size)[1].T
        mine = entries_at(best)
        start = jax.tree.map(
            lambda leaf: jnp.take_along_axis(leaf, best[(None,) * (leaf.ndim - 2)], axis=-2), starts
        )
        picked = each.pick(mine.path)
        problem = problem_of(picked, details[:, None], mine, scale, box, mine.tied)
        tied, loose, _ = descend(problem, start, STEPS, LAST_STEPS)
        return best, picked.at(tied.origin), tied, loose

    def posterior_of(block: _Block) -> tuple[Array, Table]:
        entries = entries_at(block.codes)
        return compare(block.evidence, block.amplitudes, block.at.pitch, entries, details), entries

    def judge_round(r: Array, rounds: _Block) -> _Block:
        """A first look at every block of entries; then the fit of the best ones."""
        mine, forms, at, loose = jax.lax.cond(r < blocks, look, fit, r, rounds)
        amplitudes, evidence = _judge(forms, at, entries_at(mine), of)
        # an entry whose numbers cannot be computed, as where nothing moves, is not probable
        unknown = jnp.isnan(evidence) | jnp.isnan(amplitudes.size)
        amplitudes = jax.tree.map(lambda leaf: jnp.where(jnp.isnan(leaf), 1, leaf), amplitudes)
        amplitudes = amplitudes._replace(size=jnp.where(unknown, 1e30, amplitudes.size))
        found = _Block(mine, at, loose, amplitudes, jnp.where(unknown, -jnp.inf, evidence))
        return jax.tree.map(lambda whole, new: whole.at[r].set(new), rounds, found)

    def shape_of_round() -> _Block:
        mine, forms, at, loose = look(jnp.int32(0), None)  # type: ignore[arg-type]
        return _Block(mine, at, loose, *_judge(forms, at, entries_at(mine), of))

    empty = jax.tree.map(
        lambda leaf: jnp.zeros((blocks + 1, *leaf.shape), leaf.dtype), jax.eval_shape(shape_of_round)
    )
    rounds = jax.lax.fori_loop(0, blocks + 1, judge_round, empty)
    # entries that were not fitted keep what the first look found
    looked = jax.tree.map(lambda leaf: _flat(leaf[:blocks])[..., :number, :], rounds)
    fitted = jax.tree.map(lambda leaf: leaf[blocks], rounds)
    same = looked.codes[:, None] == fitted.codes[None]  # (E, C, N)
    looked = looked._replace(evidence=jnp.where(jnp.any(same, axis=1), -jnp.inf, looked.evidence))
    both = jax.tree.map(lambda one, other: jnp.concatenate([one, other], axis=-2), looked, fitted)
    posterior, entries = posterior_of(both)
    everywhere = jnp.max(jnp.where(same, posterior[None, number:], posterior[:number, None]), axis=1)
    entries = Table(*(leaf[..., number:, :] for leaf in entries))
    return Solved(
        everywhere.T,
        _parameters(fitted.loose, entries, of),
        origins,
        norm,
        _first(axes.linear),
        _first(axes.angular),
        _start_parameters(starts, mean),
        fitted.codes.T,
        scale,
    )


class _Block(NamedTuple):
    """Some entries of every window: codes (C, N), unknowns, those with a free tilt, amplitudes, evidence."""

    codes: Array
    at: Unknowns
    loose: Unknowns
    amplitudes: Amplitudes
    evidence: Array


def _flat(leaf: Array) -> Array:
    """(blocks, ..., C, N) to (..., blocks * C, N)."""
    moved = jnp.moveaxis(leaf, 0, -3)
    return moved.reshape(*moved.shape[:-3], -1, moved.shape[-1])


def _first(leaf: Array) -> Array:
    """(components, entries, N) to (N, entries, components)."""
    return jnp.moveaxis(leaf, (-1, -2), (0, 1))


def _start_parameters(at: Unknowns, mean: Array) -> Parameters:
    """Parameters (N, E, ...) of the starts of all entries but universal joints."""
    turned = times(jnp.swapaxes(mean[:, :, None], 0, 1), at.frame)
    axes = jnp.where(in_body(TABLE)[:, None], at.frame, turned)
    return Parameters(*(_first(leaf) for leaf in (axes, at.origin, at.tilt, at.pitch)))


def _parameters(at: Unknowns, entries: Table, of: _Windows) -> Parameters:
    """Parameters (N, entries, ...) of unknowns in axes of the main body."""
    joint, mean = of.joint, of.mean[:, :, None]
    axes = jnp.where(in_body(entries), at.frame, times(jnp.swapaxes(mean, 0, 1), at.frame))
    cross_axes, cross_tilt = crossed_frame(joint.ground, joint.body, of.mean)
    axes = jnp.where(entries.crossed, cross_axes[:, :, None], axes)
    tilt = jnp.where(entries.crossed, cross_tilt[:, None], at.tilt)
    return Parameters(*(_first(leaf) for leaf in (axes, at.origin, tilt, at.pitch)))


def _judge(forms: Forms, at: Unknowns, entries: Table, of: _Windows) -> tuple[Amplitudes, Array]:
    """Amplitudes and log evidence of entries, with (entries, N) last."""
    turns, shifts, mixed = coordinates_at(forms, at, entries.apart)
    joint, crossed = of.joint, entries.crossed
    # ---- the rotations of a universal joint are others
    turns = jnp.where(crossed, joint.form[:, :, :, None], turns)
    of_path = jnp.where(
        entries.path == PATHS.index("GB"), joint.mixed[:, :, :, 0, :, None], joint.mixed[:, :, :, 1, :, None]
    )
    of_path = of_path[:, :, 0] + total(of_path[:, :, 1:] * at.origin[:, None], 2)
    of_path = total(of_path[:, :, None] * at.frame[None, :, :, None], 1)
    mixed = jnp.where(crossed, of_path, mixed)
    # ---- sensitivity to a rotation
    unit = jnp.eye(3, dtype=turns.dtype)[:, :, None, None] + jnp.zeros_like(at.frame)
    sine = total(joint.sine, 0) / len(joint.sine)
    corner = (np.arange(9) == 0).reshape(3, 3, 1, 1)
    of_turns = jnp.where(crossed & corner, sine, unit)
    kinds = jnp.arange(len(PATHS)).reshape(-1, 1, 1) == entries.path[None]
    lever = total(of.levers[:, :, :, None] * kinds, 2)
    lever = sandwich(at.frame, lever[:, :, None])[:, :, 0]
    third = (np.arange(3) == 2)[:, None, None]
    row = entries.apart & (third[:, None] | third[None])
    lever = jnp.where(row, jnp.where(third[:, None] & third[None], at.pitch**2, 0), lever)
    # ---- derivative of the coordinates with respect to the pose
    axis = times(of.mean[:, :, None], times(at.frame, tilted_axis(at.tilt)))
    along = total(of.turned[:, :, :, None] * at.frame[None, :, 2, None], 1)
    cosine = total(along * axis[:, None], 0)
    det = jnp.where(entries.apart & in_body(entries), jnp.abs(cosine), 1.0)
    det = jnp.where(crossed, joint.sine[:, None], det)
    gain = jnp.asarray([0.0, 0, 0, 1, 1, 1], turns.dtype)[:, None, None]
    consistency = total(jnp.log(det + 1e-6), 0) / len(det)
    coordinates = Coordinates(turns, shifts, mixed, jnp.stack([of_turns, lever]), gain, consistency)
    amplitudes = materialize(amplitudes_of(coordinates, entries, of.spectra))
    tilt = jnp.where(entries.tied, jnp.sqrt(total(at.tilt**2, 0) + jnp.finfo(turns.dtype).tiny), 0)
    return amplitudes, log_evidence(amplitudes, tilt, entries, of.own)


def _joint(a: Array, b: Array, products: Array, features: Features) -> _Joint:
    """Moments of a'R b and of the rotations about a and b; see :class:`_Joint`."""
    rows = jnp.asarray(ROWS, products.dtype)
    angle = jnp.einsum("in,jn,ijf->nf", a, b, rows[KINDS.index("angle between"), :, 1:])
    turns = [
        jnp.einsum("in,if->nf", v, rows[KINDS.index(f"turn in {where}"), :, 0])
        for v, where in ((a, "ground"), (b, "body"))
    ]
    weights = jnp.stack([angle, *turns])
    half = jnp.einsum("inf,nsfg->nsig", weights, products, precision="highest")
    form = jnp.einsum("nsif,jnf->ijsn", half, weights, precision="highest")
    paths = ROWS[[KINDS.index(t.name) for t in (LinearType.GB, LinearType.BG)]]
    sign = jnp.asarray(paths.sum(-1), products.dtype)
    mixed = half[..., np.abs(paths).argmax(-1)] * sign  # (N, S, 3, 2, 3, 4)
    mixed = mixed.transpose(2, 4, 5, 3, 1, 0)
    turned = features.to_rotation[:, :, z.TURN_GROUND]
    cosine = jnp.einsum("in,nmij,jn->mn", a, turned, b)
    return _Joint(a, b, form, mixed, 1 - cosine * cosine)


def _levers(features: Features, turned: Array, place: Array) -> Array:
    """Squared sensitivity to a rotation of translations along directions, (3, 3, 5, N)."""
    sensitive = jnp.moveaxis(features.to_rotation[:, :, z.IN_BODY], 0, -1)
    inside = jnp.stack([sensitive[:, 2, 1], sensitive[:, 0, 2], sensitive[:, 1, 0]])  # R'p, (3, M, N)
    position = times(turned, inside)
    x = place[:, :, None]
    moved = [
        jnp.broadcast_to(x[:, LinearType.BB], inside.shape),
        times(turned, jnp.broadcast_to(x[:, LinearType.GB], inside.shape)),
        x[:, LinearType.GG] - position,
        times(turned.swapaxes(0, 1), jnp.broadcast_to(x[:, LinearType.BG], inside.shape)) - inside,
        jnp.zeros_like(inside),
    ]
    arms = jnp.stack(moved, axis=2)  # (3, M, 5, N)
    squares = total(arms[:, None] * arms[None], 2) / arms.shape[1]
    unit = jnp.eye(3, dtype=arms.dtype)[:, :, None, None]
    return unit * (squares[0, 0] + squares[1, 1] + squares[2, 2]) - squares


def _tilt_scale(axes: Axes, whole: Array) -> Array:
    """Size of the tilt in the fit: amplitude of the rotations across the axis of the largest, (N,) rad."""
    across = sandwich(axes.angular[:, :, 1], whole[z.TURN_BODY, z.TURN_BODY][:, :, None])[:2, :2, 0]
    trace = across[0, 0] + across[1, 1]
    det = across[0, 0] * across[1, 1] - across[0, 1] * across[1, 0]
    return jnp.sqrt(jnp.maximum(trace - det / jnp.maximum(trace, 1e-30), 0) + 1e-12)


def _own_noise(products: Array, all_details: Array, white: Array, noise: Array) -> Array:
    """White noise, (2, N) m and rad, no more than any scale shows along its stillest axis."""
    forms = jnp.stack([products[r, r, :-1] for r in (z.POSITION, z.TURN_BODY)], axis=2)
    shown = jnp.where(all_details[:-1] > 0, smallest_eigenvalue(forms) / white[:-1], jnp.inf)
    return jnp.minimum(noise.T, jnp.sqrt(jnp.maximum(-largest(-shown, 1), 1e-16)))
