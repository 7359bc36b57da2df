"""Identification of windows that have been checked: pure functions of arrays.

poses -> evidence (:mod:`.evidence`) -> optimum of every type (:mod:`.optima`) -> how far each axis moved and
what is free (:mod:`.decision`, :mod:`.distances`, :mod:`.freedom`) -> Identification.
"""

from dataclasses import replace
from functools import partial

import jax

from reframe_jax.arrays import jnp, lax
from reframe_jax.compilation import as_one_kernel, once
from reframe_jax.constraints.located import ground_offset
from reframe_jax.constraints.types import POSITION_BODIES
from reframe_jax.identification.cautions import Caution, caution_codes
from reframe_jax.identification.classify import Thresholds, free_rotations, nearest_origin, tied_types
from reframe_jax.identification.coupling import coupled_positions
from reframe_jax.identification.decision import Settled, decide
from reframe_jax.identification.distances import free_probabilities
from reframe_jax.identification.evidence import IN_BODY, Evidence, LagRule, reduce_windows
from reframe_jax.identification.likelihood import likeliest_frames
from reframe_jax.identification.naming import EVEN, is_universal, name_probability, turns_about_point
from reframe_jax.identification.optima import (
    Frames,
    Optima,
    find_optima,
    orient_axes,
    pick_problem,
    pick_type,
)
from reframe_jax.identification.plane_of_motion import use_plane
from reframe_jax.identification.results import (
    AllCandidates,
    AngularFrame,
    Candidates,
    Identification,
    LinearFrame,
)
from reframe_jax.identification.shared_axis import share_axis
from reframe_jax.identification.twins import find_twins
from reframe_jax.identification.universal import Universal, find_universal
from reframe_jax.identification.widening import SearchSpace, is_steep
from reframe_jax.motion.checks import Status
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Solver

__all__ = ["identify_windows", "solve_evidence"]


def identify_windows(
    poses: jax.Array,
    steps: jax.Array,
    count: jax.Array | None,
    lag: jax.Array | None,
    thresholds: Thresholds | None,
    space: SearchSpace,
    key: jax.Array,
    rule: LagRule,
    exponent: float,
    discretization: Discretization,
    solver: Solver,
) -> Identification:
    """Identify windows whose shapes and options have been checked, all at once.

    Arguments of :func:`reduce_windows` and :func:`solve_evidence`.
    """
    evidence = once(reduce_windows(poses, steps, count, lag, rule, discretization))
    # these count as given; once() would make tangents of zeros, to be followed through all that reads them
    noise, share, samples = lax.stop_gradient((evidence.noise, evidence.share, evidence.samples))
    evidence = replace(evidence, noise=noise, share=share, samples=samples)
    return solve_evidence(evidence, thresholds, space, key, rule, exponent, solver)


def solve_evidence(
    evidence: Evidence,
    thresholds: Thresholds | None,
    space: SearchSpace,
    key: jax.Array,
    rule: LagRule,
    exponent: float,
    solver: Solver,
) -> Identification:
    """Find the optimum of every type, the best of each group, and what is free.

    Args:
        evidence: of N windows.
        thresholds: above which an axis is free; None to let the noise of the recording decide.
        space: where positions are searched, m.
        key: of the solver's random numbers.
        rule: that the evidence was made by; for "auto" the frames are refined where the noise is white.
        exponent: of the power mean over axes.
        solver: search for the position.
    """
    optima = find_optima(evidence, space, key, rule, exponent, solver)
    settled = decide(evidence, optima, thresholds, rule, exponent)
    optima = replace(optima, linear_winner=settled.winner)
    twins = _twins(evidence, optima, settled)
    universal = _universal(evidence, settled)
    frames = settled.frames
    if rule == "auto":
        frames = as_one_kernel(_refine, evidence, optima, settled)
    return as_one_kernel(_report, evidence, optima, settled, frames, twins, universal, thresholds)


def _refine(evidence: Evidence, optima: Optima, settled: Settled) -> Frames:
    """The frames to report, with what is known once it is known what is free."""
    frames, dof, refined = settled.frames, settled.dof, settled.refined & ~settled.on_axis
    if evidence.maps is None:
        frames = likeliest_frames(evidence, frames, optima, dof, settled.idle, refined)
    frames = share_axis(evidence, frames, dof, optima.linear_winner, refined)
    return use_plane(evidence, frames, dof[0], ~settled.refined & ~settled.on_axis)


def _report(
    evidence: Evidence,
    optima: Optima,
    settled: Settled,
    frames: Frames,
    twins: tuple[jax.Array, jax.Array],
    universal: Universal,
    thresholds: Thresholds | None,
) -> Identification:
    """What is said of every window."""
    dof, on_axis, screw = settled.dof, settled.on_axis, settled.screw
    angular = Candidates(
        rotvec=orient_axes(frames.angular_axes, dof[0]),
        dof=dof[0],
        rms=optima.angular_rms,
        norm=optima.angular_norm,
        free_rotation=free_rotations(dof[0]),
    )
    free, position = nearest_origin(
        optima.objective.moments,
        frames.local_axes,
        dof[1],
        optima.rms,
        frames.position,
        settled.idle[:, None],
    )
    free = jnp.where(on_axis[:, None, None, None], _along(frames.angular_axes), free)
    position = jnp.where(on_axis[:, None, None], frames.position, position)
    on_bounds = _on_bounds(optima, position) & ~on_axis[:, None]
    position = ground_offset(evidence.centre) + position
    linear = Candidates(
        rotvec=orient_axes(frames.axes, dof[1]),
        dof=dof[1],
        rms=optima.rms,
        norm=optima.norm,
        free_rotation=free_rotations(dof[1]),
        position=position,
        free_position=free,
        on_bounds=on_bounds,
        agreement=optima.solution.agreement,
    )
    linear_frame = _linear_frame(linear, (position, free), twins, evidence, optima, settled)
    angular_frame = _angular_frame(angular, evidence, optima, settled.patterns)
    n = optima.linear_winner
    axes = frames.angular_axes, pick_type(frames.axes, n)
    screws = jnp.where(on_axis, screw.probability, 0)
    freedom = angular_frame.dof, linear_frame.dof
    probability = name_probability(settled.classes, n, freedom, axes, screws, universal.probability)
    named = on_axis & (screws > EVEN)
    cautions = {
        Caution.FAR_ORIGIN: optima.widened & ~on_axis,
        Caution.ROUNDED: evidence.rounded,
        # thresholds name a class whatever its probability
        Caution.IMPROBABLE: (probability < EVEN) & (thresholds is None),
        Caution.COUPLED: jnp.any(linear_frame.coupled_position != 0, axis=(-2, -1)),
    }
    found = Identification(
        angular=angular_frame,
        linear=linear_frame,
        candidates=AllCandidates(angular=angular, linear=linear),
        class_probability=settled.classes,
        screw_probability=screws,
        pitch=jnp.where(named, screw.pitch, jnp.nan),
        universal_probability=universal.probability,
        universal_axes=jnp.where(
            is_universal(freedom, universal.probability)[:, None, None], universal.axes, jnp.nan
        ),
        noise=evidence.noise,
        lag=evidence.lag,
        refined=settled.refined,
        counted=evidence.counted,
        status_code=jnp.zeros_like(evidence.status),
        warning_codes=_warning_codes(evidence, optima, thresholds, cautions),
    )
    return _with_status(found, evidence.status, pick_type(on_bounds, n))


def _universal(evidence: Evidence, settled: Settled) -> Universal:
    """The universal joints, among windows that turn about a point."""
    frames, dof = settled.frames, (settled.dof[0][:, 0], pick_type(settled.dof[1], settled.winner))
    return find_universal(evidence, frames.angular_axes, frames.position[:, IN_BODY], turns_about_point(dof))


def _twins(evidence: Evidence, optima: Optima, settled: Settled) -> tuple[jax.Array, jax.Array]:
    """Of the best linear type, (N, 3) m and (N,) bool; see :func:`find_twins`."""
    n = optima.linear_winner
    searched, solution, box = jax.tree.map(
        partial(pick_problem, n), (optima.searched, optima.solution, optima.box)
    )
    idle = lax.stop_gradient(settled.idle)
    return find_twins(searched, box, solution, pick_type(settled.dof[1], n), idle, evidence.samples)


def _angular_frame(
    candidates: Candidates, evidence: Evidence, optima: Optima, patterns: jax.Array
) -> AngularFrame:
    a = optima.angular_winner
    tied = tied_types(candidates.rms, candidates.dof, a, evidence.samples)
    # unless exactly two axes are free, both angular types express the same constraint (section 3.3)
    tied = tied | (jnp.sum(pick_type(candidates.dof, a), axis=-1) != 2)[:, None]
    return AngularFrame(
        type_code=a,
        rotvec=pick_type(candidates.rotvec, a),
        dof=pick_type(candidates.dof, a),
        free_probability=free_probabilities(jnp.sum(_of_winner(patterns, optima), axis=2)),
        rms=pick_type(candidates.rms, a),
        norm=pick_type(candidates.norm, a),
        norms=candidates.norm,
        tied=tied,
        free_rotation=pick_type(candidates.free_rotation, a),
    )


def _linear_frame(
    candidates: Candidates,
    origin: tuple[jax.Array, jax.Array],
    twins: tuple[jax.Array, jax.Array],
    evidence: Evidence,
    optima: Optima,
    settled: Settled,
) -> LinearFrame:
    n, told = optima.linear_winner, settled.on_axis
    searched, x = jax.tree.map(partial(pick_problem, n), (optima.searched, optima.solution.x))
    position, free = (pick_type(array, n) for array in origin)
    dof = pick_type(candidates.dof, n)
    twin, has_twin = twins
    coupled = coupled_positions(searched, x, lax.stop_gradient(free), dof, evidence.samples)
    # the turn tells which of the family of origins lies on the axis of a screw
    has_twin, coupled = has_twin & ~told, jnp.where(told[:, None, None], 0, coupled)
    offset = pick_type(ground_offset(evidence.centre), n)
    return LinearFrame(
        type_code=n,
        rotvec=pick_type(candidates.rotvec, n),
        position=position,
        twin=jnp.where(has_twin[:, None], offset + twin, lax.stop_gradient(position)),
        has_twin=has_twin,
        dof=pick_type(candidates.dof, n),
        free_probability=free_probabilities(jnp.sum(_of_winner(settled.patterns, optima), axis=1)),
        rms=pick_type(candidates.rms, n),
        norm=pick_type(candidates.norm, n),
        norms=candidates.norm,
        tied=tied_types(candidates.rms, candidates.dof, n, evidence.samples),
        free_rotation=pick_type(candidates.free_rotation, n),
        free_position=free,
        coupled_position=lax.stop_gradient(coupled),
    )


def _along(axes: jax.Array) -> jax.Array:
    """Projectors onto the third angular axis in the bodies of the linear types' origins, (N, 4, 3, 3)."""
    third = axes[..., 2][:, POSITION_BODIES]
    return third[..., :, None] * third[..., None, :]


def _on_bounds(optima: Optima, position: jax.Array) -> jax.Array:
    """Whether origins lie on the bounds, (N, 4), as reported or, where log J falls outwards, as found."""
    steep = is_steep(optima.searched, optima.box, optima.solution.x, optima.margin)
    return jnp.any(optima.box.at_face(position), axis=-1) | steep


def _of_winner(patterns: jax.Array, optima: Optima) -> jax.Array:
    """Probability of every pattern of the best linear type, (N, 4, 4)."""
    return pick_type(jnp.moveaxis(patterns, (2, 3), (0, 1)), optima.linear_winner)


def _warning_codes(
    evidence: Evidence, optima: Optima, thresholds: Thresholds | None, cautions: dict[Caution, jax.Array]
) -> jax.Array:
    rms = pick_type(optima.angular_rms, optima.angular_winner), pick_type(optima.rms, optima.linear_winner)
    return caution_codes(evidence.poses, evidence.lag, rms, thresholds, cautions)


def _with_status(found: Identification, before: jax.Array, on_bounds: jax.Array) -> Identification:
    """The results with their status, and nothing but it where a window had failed before the search."""
    still = jnp.sum(found.angular.dof, axis=-1) + jnp.sum(found.linear.dof, axis=-1) == 0
    outcome = jnp.where(on_bounds, Status.ON_BOUNDS, Status.OK)
    outcome = jnp.where(still, Status.NOT_EXCITED, outcome)
    outcome = jnp.where(_is_finite(found), outcome, Status.OUT_OF_RANGE).astype(jnp.int32)
    outcome = jnp.where(before >= 10, before, outcome)
    found = jax.tree.map(partial(_blank, outcome >= 10), found)
    return replace(found, status_code=outcome)


def _is_finite(found: Identification) -> jax.Array:
    """Whether all numbers of a window are finite, (N,)."""
    # NaN where there is no such joint
    pitch, pair = (jnp.where(jnp.isnan(x), 0, x) for x in (found.pitch, found.universal_axes))
    found = replace(found, pitch=pitch, universal_axes=pair)
    leaves = [x for x in jax.tree.leaves(found) if jnp.issubdtype(x.dtype, jnp.floating)]
    numbers = jnp.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)
    return jnp.all(jnp.isfinite(numbers), axis=1)


def _blank(failed: jax.Array, leaf: jax.Array) -> jax.Array:
    """NaN, zero or false in the failed windows."""
    empty = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.floating) else 0
    wrong = failed.reshape(failed.shape + (1,) * (leaf.ndim - 1))
    return jnp.where(wrong, jnp.asarray(empty, dtype=leaf.dtype), leaf)
