"""Second moments of the features at every time scale.

At the scale h, a detail is the difference of the means of two neighbouring blocks of h poses, at every shift
(Haar's wavelet, not decimated). Block means average white noise; differences of neighbours remove drift. The
largest scale leaves the smooth part: block means about their mean. For h = 1 the details are those of
consecutive poses, and the norm made of them is the paper's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.geometry.small import materialize

_PART = 4  # two neighbouring blocks, or a block of the smooth part, take less than 1 / _PART of a window
_FEWEST = 4  # smallest number of details of a scale
_ROUNDINGS = 16  # rounding errors of the mean square of a feature that are added to its moment
_LEAST = 1e-20  # m^2 or rad^2, smallest addition, for features that never change


class Moments(NamedTuple):
    """Moments of N windows at S scales, the last one the smooth part.

    Attributes:
        products: (N, S, F, F) mean of z z' over the details of a scale.
        details: (N, S) number of independent details; see :meth:`using`. 0 where a window has no such scale.
        width: (N, S) poses in a block, h.
        durations: (N, S, F + 1) mean of (z, T) T over the details of a scale, which take the times T, s; in
            the smooth part, T is the time from its mean. All zero without times.
    """

    products: jax.Array
    details: jax.Array
    width: jax.Array
    durations: jax.Array

    def of_steps(self) -> "Moments":
        """Select the details of consecutive poses, and the smooth part."""
        return Moments(*(leaf[:, np.array([0, -1])] for leaf in self))

    def using(self, scales: jax.Array) -> "Moments":
        """Use scales (..., S) bool: replace the numbers of details n_s by weights for sums over scales.

        White errors have n_s independent values at a scale; errors as slow as the motion have equally many at
        all scales, the fewest n_s. The weight is the geometric mean of both, and 0 at unused scales.
        """
        details = self.details * scales
        fewest = jnp.min(details, axis=-1, keepdims=True, where=details > 0, initial=1e30)
        return self._replace(details=jnp.sqrt(details * fewest))

    @property
    def scale_weight(self) -> jax.Array:
        """(..., S) weight of a scale in the variance: 1/4 for details, which count an octave four times."""
        last = jnp.arange(self.width.shape[-1]) == self.width.shape[-1] - 1
        return jnp.where(last, 1.0, 0.25).astype(self.products.dtype) * (self.details > 0)

    @property
    def white(self) -> jax.Array:
        """(..., S) mean square of details, and of the smooth part, for white noise of variance 1."""
        last = jnp.arange(self.width.shape[-1]) == self.width.shape[-1] - 1
        return jnp.where(last, 1.0, 2.0) / self.width


def scale_moments(
    values: jax.Array,
    counted: jax.Array,
    count: jax.Array,
    section: jax.Array | None = None,
    about_mean: jax.Array | None = None,
    times: jax.Array | None = None,
) -> Moments:
    """Compute the second moments of features at every scale.

    Values are features (N, F, P). A block counts if half of its poses do, ``counted`` (N, P) bool; ``count``
    (N,) is the number of poses before the padding. Details are differences within a section between gaps,
    (N, P) int, and the smooth part is relative to the mean of the section; None for one section. With
    ``about_mean`` () bool, there are no details, and displacements from the mean are the smooth part. The
    poses are recorded at the times (N, P), s.
    """
    poses, dtype = values.shape[2], values.dtype
    weight = counted.astype(dtype)[:, None]
    total, used = relative_to_mean(values, weight)
    # without noise, the moments are singular: every feature has at least the variance of rounding
    spread = jnp.sum(jnp.square(total), axis=2) / jnp.maximum(used, 1)[:, None]
    floor = _ROUNDINGS * float(jnp.finfo(dtype).eps) * jax.lax.stop_gradient(spread) + _LEAST
    floor = floor[:, None] * jnp.eye(values.shape[1], dtype=dtype)
    clock = jnp.zeros_like(weight) if times is None else times[:, None]
    total = jnp.concatenate([total, relative_to_mean(clock, weight)[0]], axis=1)
    section = jnp.zeros(counted.shape, jnp.int32) if section is None else section
    first, last = (jnp.where(counted, section, end) for end in (poses, 0))
    sections = 1 + jnp.max(last, axis=1) - jnp.min(first, axis=1)
    blocks = count if about_mean is None else jnp.where(about_mean, 0, count)  # poses that blocks contain
    length = blocks // sections  # poses in a section
    parts, details, widths = [], [], []  # parts: values of a scale, and how many of them are not zero
    block, full, width = total, weight, jnp.ones(len(values), dtype)  # of the smooth part
    whole = width  # the width without gaps
    h = 1
    while h == 1 or _PART * h < poses:
        # a block counts only if at least half of its poses count
        inside = jnp.arange(weight.shape[2]) + h <= count[:, None, None]  # no block reaches into padding
        here = ((weight >= max(1, h / 2)) & inside).astype(dtype)
        means = total * (here / jnp.maximum(weight, 1))
        if 2 * h * _PART < poses or h == 1:
            both = here[..., h:] * here[..., :-h] * _same(section, 2 * h)
            found = jnp.sum(both, axis=(1, 2))
            fits = (length > (0 if h == 1 else 2 * h * _PART)) & (found >= _FEWEST)
            parts.append(((means[..., h:] - means[..., :-h]) * both, found))
            details.append(jnp.where(fits, found / (2 * h), 0))
            widths.append(jnp.full(len(values), h, dtype))
        if h > 1:  # the largest block that fits
            here *= _same(section, h)
            fits = ((h * _PART < length) & (2 * h * _PART >= length))[:, None, None]
            block, full = (
                jnp.where(fits, jnp.pad(new, ((0, 0), (0, 0), (0, h - 1))), old)
                for new, old in ((means, block), (here, full))
            )
            width = jnp.where(fits[:, 0, 0], h, width)
            whole = jnp.where(h * _PART < blocks, h, whole)
        total, weight = materialize((total[..., h:] + total[..., :-h], weight[..., h:] + weight[..., :-h]))
        h *= 2
    rest, found = relative_to_mean(block, full)
    parts.append((relative_to_section(rest, full, section), found))
    # motion is correlated: short sections tell no more of its smooth part than a recording without gaps
    details.append(jnp.maximum(jnp.minimum(used / width - sections, used / whole - 1), 0.5))
    # sums are stacked before they are divided: a CPU does not vectorize what it concatenates
    sums = [jnp.einsum("nfd,ngd->nfg", each, each, precision="highest") for each, _ in parts]
    counts = jnp.stack([found for _, found in parts], axis=1)[..., None, None]
    products = materialize(jnp.stack(sums, axis=1)) / jnp.maximum(counts, 1)
    return Moments(
        products=products[:, :, :-1, :-1] + floor[:, None],
        details=jnp.stack(details, axis=1),
        width=jnp.stack([*widths, width], axis=1),
        durations=products[:, :, -1],
    )


def _same(section: jax.Array, poses: int) -> jax.Array:
    """Return whether so many consecutive poses are in one section, (N, 1, P - poses + 1) bool."""
    return (section[:, poses - 1 :] == section[:, : section.shape[1] + 1 - poses])[:, None]


def relative_to_mean(values: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Values (N, F, P) relative to their mean, 0 where the weight (N, 1, P) is 0; sum (N,) of the weights."""
    found = jnp.sum(weight, axis=(1, 2))
    mean = jnp.sum(values * weight, axis=2) / jnp.maximum(found, 1)[:, None]
    return (values - mean[..., None]) * weight, found


def relative_to_section(values: jax.Array, weight: jax.Array, section: jax.Array) -> jax.Array:
    """Values (N, F, P), relative to their mean, relative to the mean of their section (N, P) instead.

    The weight (N, 1, P) is 1, or 0 where values do not count and are 0.
    """

    def relative(values: jax.Array, weight: jax.Array, section: jax.Array) -> jax.Array:
        sums = jax.ops.segment_sum(jnp.concatenate([values, weight]).T, section, len(section))[section].T
        return (values - sums[:-1] / jnp.maximum(sums[-1], 1)) * weight

    one = jnp.all(section == section[:, :1])
    return jax.lax.cond(one, lambda values, *_: values, jax.vmap(relative), values, weight, section)
