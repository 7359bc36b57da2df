"""Check the excitation: whether a motion was rich enough to determine the constraint.

An identification infers constrained axes from motions that did not occur. A motion that nobody tried does not
occur either. Two motions with a fixed velocity ratio cancel at some point, so the body seems to have one
degree of freedom less there. Three kinds of motion therefore determine less than the identified frames
suggest:

- the body followed a single path: the motion tested this path only;
- a velocity was constant: its ratio to any other constant velocity is fixed;
- velocities along free axes were proportional: there were fewer independent motions than free axes.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.geometry.small import count_independent, solve_positive
from reframe_jax.identification.certainty import Excitation
from reframe_jax.identification.naming import constraint_of
from reframe_jax.identification.optima import smallest_scale
from reframe_jax.identification.options import Scales
from reframe_jax.identification.preparation import Prepared
from reframe_jax.identification.results import Identification
from reframe_jax.model.fit import coordinates
from reframe_jax.model.table import ENTRIES
from reframe_jax.uncertainty.refit import Windows, over_windows

_STEADY = 0.03  # residual fraction of a constant, fitted by velocities, below which a velocity is constant
_PROPORTIONAL = 1e-3  # residual fraction of a velocity, fitted by the others, below which it is dependent
_NOISES = 3.0  # smallest ratio of a motion to its noise
_NAMED = np.array([constraint_of(code) is not None for code in range(len(ENTRIES))])


def excitation(
    found: Identification,
    poses: "ArrayLike",
    *,
    times: "ArrayLike | None" = None,
    dt: "ArrayLike | None" = None,
    scales: Scales = "auto",
) -> Excitation:
    """Compute the degrees of freedom of a constraint that a motion tested.

    Args:
        found: the identification of these poses by :func:`reframe_jax.identify`.
        poses: (..., K+1, 4, 4) m, the same as for the identification.
        times: (K+1,) or (..., K+1) s, the same as for the identification.
        dt: s, the same as for the identification.
        scales: the same as for the identification.

    Returns:
        The excitation, with the leading axes of ``found``. For failed windows, and for constraints without an
        entry in the table, all numbers are 0 and all flags False.

    Raises:
        ValueError: if the poses differ from the poses of ``found``.
    """
    return over_windows(_window_excitations, found, poses, times, dt, scales)


def _window_excitations(window: Prepared, windows: Windows, _: jax.Array) -> Excitation:
    _, used, _, mean_rotation, entry, start, found, _ = windows
    straight = start._replace(pitch=jnp.zeros_like(start.pitch))
    weights = jax.vmap(coordinates)(straight, mean_rotation, entry)
    # velocities are displacements at the smallest scale over the RMS duration
    smallest = jax.vmap(smallest_scale)(used)
    products, durations, width = (
        jnp.einsum("ns,ns...->n...", smallest.astype(leaf.dtype), leaf)
        for leaf in (used.products, used.durations, used.width)
    )
    square = durations[:, -1:]
    gram = jnp.einsum("nif,nfg,njg->nij", weights, products, weights) / square[..., None]
    mean = jnp.einsum("nif,nf->ni", weights, durations[:, :-1]) / square
    reach = [jnp.einsum("nif,nmfc->nmic", weights, of) for of in window.features[1:3]]
    gain = [jnp.mean(jnp.sum(jnp.square(of), axis=-1), axis=1) for of in reach]
    variance = gain[0] * window.noise[:, :1] ** 2 + gain[1] * window.noise[:, 1:] ** 2
    noise = 2 * variance / (width[:, None] * square)
    free = ~jnp.asarray(entry.held) | (entry.pitch[:, None] & (jnp.arange(6) == 5))
    motions, steady = jax.vmap(_independent_motions)(gram, mean, noise, free)
    failed = (window.status >= 10) | (found.entry_code < 0)
    number = jnp.sum(found.angular.dof, axis=1) + jnp.sum(found.linear.dof, axis=1) - entry.pitch
    return Excitation(
        free=jnp.where(failed, 0, number),
        motions=jnp.where(failed, 0, motions),
        steady=steady & ~failed & (number > 0),
        named=jnp.asarray(_NAMED)[found.entry_code] & ~failed,
    )


def _independent_motions(
    gram: jax.Array, mean: jax.Array, noise: jax.Array, free: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Number of independent motions of one window, and whether a sum of free velocities is constant.

    ``gram`` (6, 6) are mean products of velocities, of which the noise adds ``noise`` (6,) to the diagonal;
    ``mean`` (6,) are the constant velocities that fit best, ``free`` (6,) whether each axis is free.
    """
    tiny = jnp.finfo(gram.dtype).tiny ** 0.5
    unit = jnp.where(free, 1 / jnp.sqrt(jnp.maximum(jnp.diagonal(gram), tiny)), 0)
    rest = gram * unit[:, None] * unit[None]
    level = noise * jnp.square(unit)
    # the noise term excludes differences of proportional velocities, which contain no signal
    lifted = rest + jnp.diag(jnp.where(free, level + 1e-9, 1))
    constant = (mean * unit) @ solve_positive(lifted, mean * unit)
    least = jnp.maximum(_NOISES**2 * level, _PROPORTIONAL)
    return count_independent(rest, jnp.where(free, least, jnp.inf)), 1 - constant < _STEADY
