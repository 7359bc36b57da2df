"""What is decided about windows: which frames to report, what is free, and which type is the likeliest."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.compilation import as_one_kernel
from reframe_jax.identification.classify import (
    Thresholds,
    class_probabilities,
    degrees_of_freedom,
    likeliest_type,
    tied_types,
)
from reframe_jax.identification.distances import (
    distances_at_rest,
    is_white,
    likeliest_pattern,
    pattern_probabilities,
)
from reframe_jax.identification.evidence import IN_BODY, IN_GROUND, Evidence, LagRule
from reframe_jax.identification.naming import EVEN, holds_for_all_types
from reframe_jax.identification.optima import Frames, Optima, pick_problem, pick_type, refine_frames
from reframe_jax.identification.screw import Screw, find_screw

__all__ = ["Settled", "decide"]


class Settled(NamedTuple):
    """What is decided about N windows.

    Attributes:
        frames: to report.
        patterns: (4, 4, N, 4) probability of every pattern of degrees of freedom.
        classes: (N, 4, 4, 4) probability of every linear type and pattern.
        dof: (N, 2, 3) and (N, 4, 3).
        refined: (N,) bool, see :class:`Identification`.
        on_axis: (N,) bool, whether the frames are those of a screw.
        winner: (N,) linear type: the likeliest one, or for given chords that of the lowest norm; on
            a screw, and where it makes no difference, one whose origin has a path.
        screw: the screws.
        idle: (N,) rad/s, RMS of rotation about axes that are classified as constrained. It counts as noise,
            unless it was taken out.
    """

    frames: Frames
    patterns: jax.Array
    classes: jax.Array
    dof: tuple[jax.Array, jax.Array]
    refined: jax.Array
    on_axis: jax.Array
    winner: jax.Array
    screw: Screw
    idle: jax.Array


def decide(
    evidence: Evidence, optima: Optima, thresholds: Thresholds | None, rule: LagRule, exponent: float
) -> Settled:
    """Decide which frames to report, and which axes are free."""
    refining = rule == "auto" and evidence.maps is None
    rough = Frames(optima.angular_axes, optima.position, optima.axes, optima.local_axes)
    frames = rough
    if refining:
        refine = partial(refine_frames, exponent=exponent)
        frames = as_one_kernel(refine, evidence, optima.position, optima.box)
    first_look = partial(_first_look, refining=refining)
    resting = as_one_kernel(distances_at_rest, lax.stop_gradient(evidence))
    frames, screw, patterns, white = as_one_kernel(first_look, evidence, optima, frames, rough, resting)
    judge = partial(_judge_again, refining=refining)
    # what is free does not follow the poses: nothing is differentiated that leads there only
    given = (*lax.stop_gradient((evidence, optima, rough, screw)), resting, thresholds)
    # one program for both, which mostly has nothing to do
    first = jnp.all(white).astype(jnp.int32) if refining else 1
    until = 1 + jnp.any(screw.likely).astype(jnp.int32)
    start = patterns, white, jnp.zeros_like(white), jnp.zeros_like(white)
    judged = lax.fori_loop(
        first, until, lambda step, so_far: as_one_kernel(judge, step, so_far, *given), start
    )
    settle = partial(_settle, likeliest=rule == "auto" and thresholds is None)
    return as_one_kernel(settle, evidence, optima, frames, screw, judged, thresholds)


def _first_look(
    evidence: Evidence,
    optima: Optima,
    frames: Frames,
    rough: Frames,
    resting: tuple[jax.Array, jax.Array],
    refining: bool,
) -> tuple[Frames, Screw, jax.Array, jax.Array]:
    """How free the axes of refined frames are; the rough ones where the noise is not white; the screws.

    Returns:
        The frames, the screws, the patterns, and (N,) bool, whether the noise is white.
    """
    n = optima.linear_winner
    fixed, seen = lax.stop_gradient((evidence, frames))
    patterns, distance = pattern_probabilities(fixed, optima.angular_winner, seen, resting)
    white = jnp.zeros(n.shape, dtype=bool)
    if refining:
        white = is_white(pick_problem(n, distance), likeliest_pattern(patterns, n), n)
        frames = jax.tree.map(partial(_choose, white), frames, rough)
    turns_once = jnp.sum(pick_problem(n, patterns)[1], axis=0) > EVEN
    screw = find_screw(evidence, frames, optima.box, turns_once, resting[0][0, :, 0])
    return frames, screw, patterns, white


def _judge_again(
    step: jax.Array,
    so_far: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    evidence: Evidence,
    optima: Optima,
    rough: Frames,
    screw: Screw,
    resting: tuple[jax.Array, jax.Array],
    thresholds: Thresholds | None,
    refining: bool,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Judge the rough frames of windows whose noise is not white, then those on the axis of a slide.

    Args:
        step: 0, then 1.
        so_far: the patterns, and (N,) bool each, whether the noise is white, whether they are on a screw, and
            whether on the axis of a hinge that errors had tilted.
        evidence: of the windows.
        optima: of all types.
        rough: frames that are not refined.
        screw: the screws.
        resting: of :func:`.distances_at_rest`.
        thresholds: above which an axis is free.
        refining: whether other frames are refined.
    """
    patterns, white, on_axis, on_hinge = so_far
    last = step == 1
    followed = replace(optima, linear_winner=_with_a_path(optima))
    those = jax.tree.map(lambda *both: jnp.where(last, both[1], both[0]), rough, screw.frames)
    rest = jnp.where(last & screw.likely & evidence.axis.found, screw.rest, 0)
    new, distance = pattern_probabilities(evidence, optima.angular_winner, those, resting, rest)
    dof = _freedom(new, followed, thresholds)
    winner = followed.linear_winner
    turns, slides = jnp.sum(dof[0][:, 0], axis=-1), jnp.sum(pick_type(dof[1], winner), axis=-1)
    of_winner = pick_problem(winner, distance)
    # patterns free the last axis first: the axis of rotation, if it is the one that moves
    slides_most = jnp.all(of_winner[3:5] <= of_winner[5:], axis=0)
    placed = last & screw.likely & (turns == 1) & slides_most
    helical, hinged = placed & (slides == 1), placed & (slides == 0)
    taken = helical | hinged | (~last & ~white)
    quiet = is_white(of_winner, dof, winner) & refining
    patterns = jnp.where(taken[None, None, :, None], new, patterns)
    white = jnp.where(helical, quiet, white & ~hinged)
    return patterns, white, on_axis | helical, on_hinge | hinged


def _settle(
    evidence: Evidence,
    optima: Optima,
    frames: Frames,
    screw: Screw,
    judged: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    thresholds: Thresholds | None,
    likeliest: bool,
) -> Settled:
    """What follows from the patterns; the best linear type is the likeliest one, or the one found before."""
    patterns, white, on_axis, on_hinge = judged
    n, other = optima.linear_winner, _with_a_path(optima)
    frames = jax.tree.map(partial(_choose, on_axis | on_hinge), screw.frames, frames)
    dof = _freedom(patterns, optima, thresholds)
    classes = class_probabilities(patterns, optima.rms, dof[1], n, evidence.samples)
    if likeliest:
        n = likeliest_type(classes, n)
        optima = replace(optima, linear_winner=n)
        dof = _freedom(patterns, optima, thresholds)
    # the paths of BB and GG are summed up, and their noise with them
    same = _says_the_same(optima, frames, dof, other, evidence.samples)
    by_path = on_axis | on_hinge | (white & same)
    optima = replace(optima, linear_winner=jnp.where(by_path, other, n))
    dof = _freedom(patterns, optima, thresholds)
    idle = jnp.min(jnp.max(jnp.where(dof[0] == 0, optima.angular_rms, 0), axis=-1), axis=-1)
    idle = jnp.where(evidence.alone, 0, idle)
    return Settled(frames, patterns, classes, dof, white, on_axis, optima.linear_winner, screw, idle)


def _with_a_path(optima: Optima) -> jax.Array:
    """GB or BG, whichever has the lower norm, (N,): BB and GG cannot tell the origin on a screw."""
    lower = jnp.where(optima.norm[:, IN_BODY] < optima.norm[:, IN_GROUND], IN_BODY, IN_GROUND)
    return lower.astype(optima.linear_winner.dtype)


def _says_the_same(
    optima: Optima, frames: Frames, dof: tuple[jax.Array, jax.Array], other: jax.Array, samples: jax.Array
) -> jax.Array:
    """Whether another linear type (N,) says the same as the winner, as all do of a hinge, (N,) bool."""
    n = optima.linear_winner
    of_winner = pick_type(dof[1], n)
    axes = frames.angular_axes, pick_type(frames.axes, n)
    general = holds_for_all_types(n, (dof[0][:, 0], of_winner), axes)
    tied = pick_type(tied_types(optima.rms, dof[1], n, samples), other)
    return general & tied & jnp.all(pick_type(dof[1], other) == of_winner, axis=-1)


def _choose(chosen: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    """From the new array (N, ...) the windows (N,) chosen."""
    return jnp.where(chosen.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def _freedom(
    patterns: jax.Array, optima: Optima, thresholds: Thresholds | None
) -> tuple[jax.Array, jax.Array]:
    """Degrees of freedom of all types, (N, 2, 3) and (N, 4, 3)."""
    if thresholds is None:
        return likeliest_pattern(patterns, optima.linear_winner)
    return (
        degrees_of_freedom(optima.angular_rms, thresholds.angular),
        degrees_of_freedom(optima.rms, thresholds.linear),
    )
