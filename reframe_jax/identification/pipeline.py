"""The steps of an identification, as programs.

poses -> features, moments (:mod:`reframe_jax.model`) -> the most probable entry of the table -> its frames.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from reframe_jax.compilation import Program, pipeline
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.inputs import in_chunks
from reframe_jax.identification.paper import paper_origins, step_moments
from reframe_jax.identification.preparation import Prepared, prepare_windows
from reframe_jax.identification.report import report_windows
from reframe_jax.identification.results import Identification
from reframe_jax.model.solve import Solved, choose_scales, compare_windows, search_windows
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Solver

Array = jax.Array
CHUNK = {"cpu": 32, "gpu": 16384}  # windows whose arrays fit the cache, or the memory
_Solution = tuple[Prepared, Array, Array, Solved]  # details and weights of the scales, after the windows


class Method(NamedTuple):
    """How to search for origins: by default over time scales, otherwise by :func:`.paper_origins`."""

    single_steps: bool
    exponent: float
    discretization: Discretization
    solver: Solver | None


def _identify(options: Any, windows: Any, number: Array | None, *, method: Method) -> Any:
    """Identify windows of checked poses; the windows and their number are those of :func:`.run_in_pieces`."""
    bounds, thresholds, key, allowed, scales = options  # arrays; which entries (E,) are allowed, as booleans
    window = prepare(windows[:3], number, bounds, scales, single_steps=method.single_steps)
    details, weight, solved = _search(window, number, key, scales, compare=thresholds is None, method=method)
    if thresholds is None:
        solved = solved._replace(**_compare((window, details, weight, solved), number, allowed))
    return _report((window, details, weight, solved), number, thresholds, allowed, method=method)


def _identify_in_one_program(options: Any, windows: Any, number: Array | None, *, method: Method) -> Any:
    """Identify as :func:`_identify` does, in one program, without what thresholds do not need."""
    return in_chunks(partial(_identify, options, number=None, method=method), CHUNK)(windows, number)


def _search_windows(
    window: Prepared, key: Array | None, scales: Array, *, compare: bool, method: Method
) -> tuple[Array, Array, Solved]:
    """Search by :func:`.search_windows`; also return the details and the weights of the scales."""
    single_steps, exponent, discretization, solver = method
    window = jax.lax.stop_gradient(window)
    # amplitudes are those of the whole recording, whatever the scales of the search
    used, weight = choose_scales(window.moments, window.noise, scales)
    origins, searched = None, used.of_steps() if single_steps and not compare else used
    if single_steps or exponent != 0 or solver is not None or discretization != "chord":
        key = jax.random.key(0) if key is None else key
        origins = paper_origins(window, step_moments(window, discretization)[1], exponent, solver, key)
    return used.details, weight, search_windows(window.features, searched, window.box, origins)


def _compare_windows(windows: _Solution, allowed: Array) -> dict[str, Any]:
    """Compare entries by :func:`.compare_windows`."""
    window, details, weight, solved = jax.lax.stop_gradient(windows)
    used = window.moments._replace(details=details)
    data = window.features, window.moments, used, weight, window.noise, window.box
    return compare_windows(*data, allowed, solved)


def _report_windows(
    windows: _Solution, thresholds: Thresholds | None, allowed: Array, *, method: Method
) -> Identification:
    """Report solved windows by :func:`.report_windows`, with derivatives by the poses."""
    window, details, weight, solved = windows
    live = window.moments._replace(details=details)
    of_steps = step_moments(window, method.discretization) if method.single_steps else None
    assumed = ~jnp.all(allowed)
    return report_windows(window, live, weight, solved, thresholds, method.exponent, of_steps, assumed)


prepare = Program(in_chunks(prepare_windows, CHUNK), ("single_steps",))
_search = Program(in_chunks(_search_windows, CHUNK), ("compare", "method"))
_compare = Program(in_chunks(_compare_windows, CHUNK), ())
_report = Program(in_chunks(_report_windows, CHUNK), ("method",))
identify_windows = pipeline(_identify)
identify_by_thresholds = Program(_identify_in_one_program, ("method",))
