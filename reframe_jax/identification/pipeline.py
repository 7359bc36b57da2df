"""The steps of an identification, as pure functions of arrays.

poses -> features, moments (:mod:`reframe_jax.model`) -> the most probable entry of the table -> its frames.
"""

import jax
import jax.numpy as jnp

from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.paper import paper_origins, step_moments
from reframe_jax.identification.preparation import Prepared, prepare_windows
from reframe_jax.identification.report import report_windows
from reframe_jax.identification.results import Identification
from reframe_jax.model.solve import choose_scales, solve_windows
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Solver

Array = jax.Array


def identify_windows(
    poses: Array,
    steps: Array,
    count: Array,
    bounds: Array | None,
    thresholds: Thresholds | None,
    key: Array,
    allowed: Array,
    scales: Array,
    *,
    single_steps: bool,
    exponent: float,
    discretization: Discretization,
    solver: Solver | None,
) -> Identification:
    """Identify N windows of checked poses.

    The first arguments, ``scales`` and ``single_steps`` are those of :func:`.prepare_windows`, the thresholds
    those of :func:`.report_windows`. The key, exponent, discretization and solver are those of the paper's
    search (:func:`.paper_origins`), without which origins are searched over time scales. ``allowed`` (E,)
    bool states which entries may be reported.
    """
    window = prepare_windows(poses, steps, count, bounds, scales, single_steps)
    fixed: Prepared = jax.lax.stop_gradient(window)
    # amplitudes are those of the whole recording, whatever the scales of the search
    used, weight = choose_scales(fixed.moments, fixed.noise, scales)
    of_steps = origins = None
    if single_steps or exponent != 0 or solver is not None or discretization != "chord":
        of_steps = step_moments(window, discretization)
        origins = paper_origins(fixed, jax.lax.stop_gradient(of_steps[1]), exponent, solver, key)
    compare = thresholds is None
    searched = used.of_steps() if single_steps and not compare else used
    solved = solve_windows(
        fixed.features, fixed.moments, searched, weight, fixed.noise, fixed.box, allowed, origins, compare
    )
    live = window.moments._replace(details=used.details)
    of_steps = of_steps if single_steps else None
    assumed = ~jnp.all(allowed)
    return report_windows(window, live, weight, solved, thresholds, exponent, of_steps, assumed)
