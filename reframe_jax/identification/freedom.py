"""Which axes are free: the probability of every pattern of degrees of freedom, without thresholds.

An axis is judged by how far the motion went along it, in units of the noise propagated to it: t. The model
has two groups of axes.

- *Constrained* axes show noise (t about 1); or, with a tracker that has slow errors besides its noise, some
  multiple of the noise that is unknown but common to the recording; or, along an axis of a linear frame,
  what an error in the scale of measured rotation does at the end of the lever.
- *Free* axes went far: t is unknown but of one order of magnitude for all of them, and clearly larger than
  what constrained axes show.

The unknowns are summed over with the priors below, and so are the patterns: the first axes of each frame,
sorted by velocity, are the constrained ones, so there are 4 x 4. How fast somebody moved plays no part.

The priors hold for kinds of recordings, not for single ones: noise alone, half of the time; else slow
errors of 2 to 64 noises, the larger the rarer; constraints with a name before those without.
"""

from math import log, pi

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["PATTERN_PRIOR", "freedom_patterns", "type_weights"]

PATTERN_PRIOR = np.full((4, 4), 0.1)
"""Weight of every pattern (free rotations, free translations) before any data are seen."""
for _pattern, _weight in (
    ((0, 0), 0.1),
    ((0, 1), 1.0),
    ((1, 0), 1.0),
    ((1, 1), 1.0),
    ((1, 2), 0.5),
    ((2, 0), 0.3),
    ((3, 0), 1.0),
    ((3, 1), 1.0),
    ((3, 2), 1.0),
    ((3, 3), 1.0),
):
    PATTERN_PRIOR[_pattern] = _weight

_MULTIPLES = tuple(log(2.0) * n for n in range(7))  # slow errors, in logarithms of noises; the first is none
_LIKELY = log(8.0)  # multiples up to this one are equally likely
_RARER = 1.5  # standard deviation, in logarithms, of their decline beyond
_SPREAD = 0.9  # of constrained axes about their multiple
_MISFIT = 0.15  # of the logarithm of an axis that shows noise alone, for what the noise model misses
_GAIN, _GAIN_SPREAD, _GAIN_SHARE = 0.1, 0.6, 0.15  # of measured rotation; how often an axis shows it
_FREE_SPREAD = 1.0  # of free axes about their common size
_LEAST, _LEAST_WIDTH = log(8.0), 0.25  # noises that a free axis went, at least
_APART, _APART_WIDTH = 2.3, 0.4  # between free axes and slow errors
_SIZES = log(1e6 / 4)  # range of the sizes of free motion


def _normal(x: jax.Array, mean: jax.Array | float, deviation: jax.Array | float) -> jax.Array:
    """Logarithm of the normal density."""
    return -jnp.square((x - mean) / deviation) / 2 - jnp.log(deviation * (2 * pi) ** 0.5)


def freedom_patterns(distance: jax.Array, gain: jax.Array, samples: jax.Array) -> jax.Array:
    """Probability of every pattern of degrees of freedom.

    Args:
        distance: (6, ...) how far the motion went along the axes of the angular frame, then of the linear
            frame, over the noise propagated to them; axes in the order in which they become free.
        gain: (3, ...) what all of the measured rotation makes at the end of the lever, along linear axes.
        samples: (...) independent samples.

    Returns:
        (4, 4, ...): n free rotations and m free translations at [n, m].
    """
    y = jnp.log(jnp.maximum(distance, 1e-3))
    levers = jnp.log(jnp.maximum(_GAIN * gain, 1e-9))
    white = jnp.sqrt(1 / (2 * samples) + _MISFIT**2)
    is_far = jax.nn.log_sigmoid((y - _LEAST) / _LEAST_WIDTH)
    weights = np.asarray([0.5] + [0.5 / (len(_MULTIPLES) - 1)] * (len(_MULTIPLES) - 1))
    weights *= np.exp(-np.square(np.maximum(np.asarray(_MULTIPLES) - _LIKELY, 0) / _RARER) / 2)
    by_gain = _normal(y[3:], levers, _GAIN_SPREAD) + log(_GAIN_SHARE)
    constrained = []
    for multiple in _MULTIPLES:
        if multiple == 0:
            constrained.append(_normal(jnp.maximum(y, 0), 0.0, white))
            continue
        own = _normal(y, multiple, _SPREAD)
        linear = jnp.logaddexp(own[3:] + log(1 - _GAIN_SHARE), by_gain)
        constrained.append(jnp.concatenate([own[:3], linear]))
    rows = []
    for angular in range(4):
        row = []
        for linear in range(4):
            free = [*range(3 - angular, 3), *range(6 - linear, 6)]
            held = [axis for axis in range(6) if axis not in free]
            terms = []
            for multiple, weight, each in zip(_MULTIPLES, weights, constrained, strict=True):
                term = sum((each[axis] for axis in held), jnp.zeros_like(y[0])) + log(weight)
                if free:
                    size = sum(y[axis] for axis in free[1:]) if len(free) > 1 else jnp.zeros_like(y[0])
                    size = (size + y[free[0]]) / len(free)
                    term = term + _free(y, is_far, free, size)
                    if multiple > 0:
                        term = term + jax.nn.log_sigmoid((size - multiple - _APART) / _APART_WIDTH)
                terms.append(term)
            row.append(jax.nn.logsumexp(jnp.stack(terms), axis=0) + log(PATTERN_PRIOR[angular, linear]))
        rows.append(jnp.stack(row))
    evidence = jnp.stack(rows)
    return jnp.exp(evidence - jax.nn.logsumexp(evidence, axis=(0, 1), keepdims=True))


def _free(y: jax.Array, is_far: jax.Array, free: list[int], size: jax.Array) -> jax.Array:
    """Free axes of a common size, over which is summed: a Gaussian integral."""
    n = len(free)
    scatter = sum(jnp.square(y[axis] - size) for axis in free)
    far = sum(is_far[axis] for axis in free)
    width = log((2 * pi) ** 0.5 * _FREE_SPREAD / n**0.5) - log(_SIZES)
    return far - scatter / (2 * _FREE_SPREAD**2) - n * log(_FREE_SPREAD * (2 * pi) ** 0.5) + width


def type_weights(excess: jax.Array, margin: jax.Array) -> jax.Array:
    """Probability of every frame type, (..., T), from what it exceeds the best by.

    Args:
        excess: (..., T) see :func:`reframe_jax.identification.classify.excess_over`.
        margin: (...) three standard deviations of it.
    """
    deviations = 3 * jnp.maximum(excess, 0) / margin[..., None]
    return jax.nn.softmax(-jnp.square(jnp.minimum(deviations, 30)) / 2, axis=-1)
