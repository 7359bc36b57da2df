"""What a motion could tell: constraints that moved too simply look simpler than they are.

A constraint is read off the motions that did not occur. Those that nobody tried do not occur either, and two
that keep one ratio cancel somewhere: at that point the body seems to have one freedom less. Three kinds of
motion therefore say less than their frames show:

- the body followed a single path, back and forth: nothing but that path was tested;
- a velocity never changed: with any other steady velocity it keeps one ratio;
- velocities of free axes were proportional, so that fewer motions were made than axes are free.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from reframe_jax.compilation import index_leaves
from reframe_jax.identification.naming import constraint_of
from reframe_jax.identification.options import Scales
from reframe_jax.identification.results import Identification, Index
from reframe_jax.model.fit import coordinates
from reframe_jax.model.table import ENTRIES
from reframe_jax.uncertainty.refit import Estimate, prepare
from reframe_jax.uncertainty.windows import over_windows

__all__ = ["Excitation", "excitation"]

_STEADY = 0.03  # share of a constant that no velocity explains, below which one of them is constant
_PROPORTIONAL = 1e-3  # share of a free velocity that the others do not explain, below which it is no motion
_NOISES = 3.0  # noises that a motion has at least
_ENDS = 8  # of a window are compared for its mean velocity: the first and the last eighth
_NAMED = np.array([constraint_of(code) is not None for code in range(len(ENTRIES))])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Excitation:
    """How much of a constraint a motion tested.

    Attributes:
        free: (...) int, degrees of freedom of the constraint that was found.
        motions: (...) int, how many of them moved independently of each other.
        steady: (...) bool, whether a velocity, or a sum of velocities, was constant throughout.
        named: (...) bool, whether the constraint has a name; if not, an axis was probably not tried.
    """

    free: jax.Array
    motions: jax.Array
    steady: jax.Array
    named: jax.Array

    def __getitem__(self, index: Index) -> "Excitation":
        """Windows of a batch, indexed like an array."""
        return index_leaves(self, index)

    @property
    def one_path(self) -> jax.Array:
        """(...) bool, whether the body followed a single path, as on a hinge or a rail."""
        return self.motions == 1

    @property
    def determined(self) -> jax.Array:
        """(...) bool, whether the motion tells the constraint: two or more independent, changing motions.

        If not, what was found is what moved; the mechanism may have more freedom.
        """
        return (self.motions > 1) & (self.motions == self.free) & ~self.steady & self.named


def excitation(
    found: Identification,
    poses: ArrayLike,
    *,
    times: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    scales: Scales = "auto",
) -> Excitation:
    """Say how much of the constraint a motion tested.

    Args:
        found: by :func:`reframe_jax.identify` from these poses.
        poses: (..., K+1, 4, 4), as given to it.
        times: (K+1,) or (..., K+1) s, as given to it.
        dt: s, as given to it.
        scales: as given to it.

    Returns:
        The excitation, with the leading axes of ``found``.

    Raises:
        ValueError: if the poses are not those of ``found``.
    """
    return over_windows(_of_windows, found, poses, times, dt, scales, parts="whole")


def _of_windows(
    poses: jax.Array,
    steps: jax.Array,
    count: jax.Array | None,
    found: Estimate,
    *,
    scales: tuple[int, ...] | None,
    parts: str,
) -> Excitation:
    window, used, mean_rotation, entry, parameters = prepare(poses, steps, count, found, scales)
    straight = parameters._replace(pitch=jnp.zeros_like(parameters.pitch))
    weights = jax.vmap(coordinates)(straight, mean_rotation, entry)
    # block differences over their width are velocities, m or rad per sample
    first = jnp.argmax(used.details > 0, axis=1)
    width = jnp.take_along_axis(window.moments.width, first[:, None], axis=1)
    products = jnp.take_along_axis(used.products, first[:, None, None, None], axis=1)[:, 0]
    gram = jnp.einsum("nif,nfg,njg->nij", weights, products, weights) / jnp.square(width)[..., None]
    index, end = jnp.arange(poses.shape[1])[None], window.count[:, None]
    size = jnp.maximum(end // _ENDS, 1)
    ends = [(window.counted & of).astype(poses.dtype) for of in (index >= end - size, index < size)]
    last, start = (
        jnp.einsum("np,npf->nf", of, window.features.values) / jnp.maximum(jnp.sum(of, axis=1), 1)[:, None]
        for of in ends
    )
    mean = jnp.einsum("nif,nf->ni", weights, last - start) / (end - size)
    reach = [jnp.einsum("nif,nmfc->nmic", weights, of) for of in window.features[1:3]]
    gain = [jnp.mean(jnp.sum(jnp.square(of), axis=-1), axis=1) for of in reach]
    noise = gain[0] * window.noise[:, :1] ** 2 + gain[1] * window.noise[:, 1:] ** 2
    noise = 2 * noise / width**3
    coupled = entry.pitch[:, None] & (jnp.arange(6) == 5)
    free = ~jnp.asarray(entry.held) | coupled
    motions, steady = jax.vmap(_tested)(gram, mean, noise, free)
    failed = window.status >= 10
    number = jnp.sum(found.angular_dof, axis=1) + jnp.sum(found.linear_dof, axis=1)
    return Excitation(
        free=jnp.where(failed, 0, number),
        motions=jnp.where(failed, 0, motions),
        steady=steady & ~failed & (number > 0),
        named=jnp.asarray(_NAMED)[found.code] & ~failed,
    )


def _tested(
    gram: jax.Array, mean: jax.Array, noise: jax.Array, free: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Number of independent motions of one window, and whether some sum of free velocities is constant.

    Args:
        gram: (6, 6) mean squares and products of velocities.
        mean: (6,) of the velocities.
        noise: (6,) what noise makes of the diagonal.
        free: (6,) bool.
    """
    tiny = jnp.finfo(gram.dtype).tiny ** 0.5
    unit = jnp.where(free, 1 / jnp.sqrt(jnp.maximum(jnp.diagonal(gram), tiny)), 0)
    rest = gram * unit[:, None] * unit[None]
    level = noise * jnp.square(unit)
    # of the motions that show the constant, noise keeps differences of proportional ones from doing so
    lifted = rest + jnp.diag(jnp.where(free, level + 1e-9, 1))
    constant = (mean * unit) @ jnp.linalg.solve(lifted, mean * unit)
    least = jnp.maximum(_NOISES**2 * level, _PROPORTIONAL)
    number = jnp.zeros((), jnp.int32)
    for _ in range(6):  # pivoted elimination: each motion leaves what it does not explain of the others
        left = jnp.diagonal(rest)
        margin = jnp.where(free, left - least, -1)
        best = jnp.argmax(margin)
        there = margin[best] > 0
        explained = jnp.outer(rest[best], rest[best]) / jnp.where(there, left[best], 1)
        rest = jnp.where(there, rest - explained, rest)
        number = number + there.astype(jnp.int32)
    return number, 1 - constant < _STEADY
