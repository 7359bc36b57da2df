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
from reframe_jax.model import solve
from reframe_jax.model.solve import Compared, ScaleWeights, Searched
from reframe_jax.motion.kinematics import Discretization
from reframe_jax.solvers import Solver

Array = jax.Array
CHUNK = {"cpu": 32, "gpu": 16384}  # windows whose arrays fit the cache, or the memory


class Method(NamedTuple):
    """How to search for origins: by default over time scales, otherwise by :func:`.paper_origins`."""

    single_steps: bool
    exponent: float
    discretization: Discretization
    solver: Solver | None


class Arrays(NamedTuple):
    """Options of an identification that are arrays, and not part of a program."""

    bounds: Any  # () m, half the width of the cube of origins; NaN for the default
    thresholds: Thresholds | None
    key: Array | None  # random key of the solver
    allowed: Any  # (E,) bool, entries of the table that may be reported
    scales: Any  # () int, see :func:`.take_scales`


def _identify(arrays: Arrays, windows: Any, number: Array | None, *, method: Method) -> Any:
    """Identify windows of checked poses; the windows and their number are those of :func:`.run_in_pieces`."""
    thresholds, compared = arrays.thresholds, None
    prepared = prepare(windows[:3], number, arrays.bounds, arrays.scales, single_steps=method.single_steps)
    compare = thresholds is None
    weights, searched = search(prepared, number, arrays.key, arrays.scales, compare=compare, method=method)
    if compare:
        compared = compare_entries((prepared, weights, searched), number, arrays.allowed)
    return report((prepared, weights, searched, compared), number, thresholds, arrays.allowed, method=method)


def _identify_in_one_program(arrays: Arrays, windows: Any, number: Array | None, *, method: Method) -> Any:
    """Identify as :func:`_identify` does, in one program, without what thresholds do not need."""
    return in_chunks(partial(_identify, arrays, number=None, method=method), CHUNK)(windows, number)


def _search(
    prepared: Prepared, key: Array | None, scales: Array, *, compare: bool, method: Method
) -> tuple[ScaleWeights, Searched]:
    """Choose the scales, and search by :func:`.search_windows`."""
    single_steps, exponent, discretization, solver = method
    prepared = jax.lax.stop_gradient(prepared)
    # amplitudes are those of the whole recording, whatever the scales of the search
    weights = solve.choose_scales(prepared.moments, prepared.noise, scales)
    used, origins = prepared.moments._replace(details=weights.search), None
    if single_steps and not compare:
        used = used.of_steps()
    if single_steps or exponent != 0 or solver is not None or discretization != "chord":
        key = jax.random.key(0) if key is None else key
        origins = paper_origins(prepared, step_moments(prepared, discretization)[1], exponent, solver, key)
    return weights, solve.search_windows(prepared.features, used, prepared.box, origins)


def _compare_entries(windows: tuple[Prepared, ScaleWeights, Searched], allowed: Array) -> Compared:
    """Compare entries by :func:`.compare_windows`."""
    prepared, weights, searched = jax.lax.stop_gradient(windows)
    features, moments, noise, box = prepared.features, prepared.moments, prepared.noise, prepared.box
    return solve.compare_windows(features, moments, weights, noise, box, searched, allowed)


def _report(
    windows: tuple[Prepared, ScaleWeights, Searched, Compared | None],
    thresholds: Thresholds | None,
    allowed: Array,
    *,
    method: Method,
) -> Identification:
    """Report windows by :func:`.report_windows`, with derivatives by the poses."""
    of_steps = step_moments(windows[0], method.discretization) if method.single_steps else None
    return report_windows(*windows, thresholds, method.exponent, of_steps, ~jnp.all(allowed))


prepare = Program(in_chunks(prepare_windows, CHUNK), ("single_steps",))
search = Program(in_chunks(_search, CHUNK), ("compare", "method"))
compare_entries = Program(in_chunks(_compare_entries, CHUNK), ())
report = Program(in_chunks(_report, CHUNK), ("method",))
identify_windows = pipeline(_identify)
identify_by_thresholds = Program(_identify_in_one_program, ("method",))
