"""Identify checked windows, with pure functions of arrays.

poses -> features, moments (:mod:`reframe_jax.model`) -> the most probable entry of the table -> its frames.
"""

import jax

from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.paper import paper_origins
from reframe_jax.identification.preparation import Prepared, prepare_windows
from reframe_jax.identification.report import report_windows
from reframe_jax.identification.results import Identification
from reframe_jax.model.solve import choose_scales, solve_windows
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Solver

__all__ = ["Prepared", "identify_windows", "prepare_windows"]

Array = jax.Array


def identify_windows(
    poses: Array,
    steps: Array,
    count: Array | None,
    bounds: Array | None,
    thresholds: Thresholds | None,
    key: Array,
    *,
    scales: tuple[int, ...] | None,
    exponent: float,
    discretization: Discretization,
    solver: Solver | None,
    assume: tuple[int, ...] | None,
) -> Identification:
    """Identify N windows.

    Args:
        poses: this and the next three as in :func:`prepare_windows`.
        steps: s.
        count: of poses.
        bounds: m.
        thresholds: above which an axis is free; None to let the evidence decide.
        key: of the solver's random numbers.
        scales: in samples; None for all that stand out of the noise.
        exponent: of the power mean over axes.
        discretization: of velocities, for the paper's search.
        solver: of the paper's search; None for the search over scales.
        assume: codes of the entries that are fitted; None for the most probable ones.
    """
    window = prepare_windows(poses, steps, count, bounds, scales)
    fixed: Prepared = jax.lax.stop_gradient(window)
    used = choose_scales(fixed.moments, fixed.noise, scales)
    paper = None
    if exponent != 0 or solver is not None or discretization != "chord":
        paper = paper_origins(fixed, exponent, discretization, solver, key)
    solved = solve_windows(
        fixed.features, fixed.moments, used, fixed.noise, fixed.box, paper, assume, thresholds is None
    )
    live = window.moments._replace(details=used.details)
    steps_only = scales == (1,)
    assumed = assume is not None
    return report_windows(window, live, solved, thresholds, exponent, discretization, steps_only, assumed)
