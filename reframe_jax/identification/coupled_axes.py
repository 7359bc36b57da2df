"""Whether a joint that couples free axes explains a motion: the probability of screws and universal joints.

On a screw the slide is proportional to the turn; in a universal joint the angle between two axes, one of each
body, is constant. What such a joint does not explain of the motion is then what errors are
(:mod:`.error_model`); otherwise it is a motion of its own, of any share of the whole.
"""

from math import log
from typing import NamedTuple

import jax

from reframe_jax.arrays import jnp, nn
from reframe_jax.identification.error_model import (
    LARGEST,
    ROTATION_ERROR_SHARE,
    UNRELATED,
    error_sizes,
    of_errors,
    of_rotation_error,
    spread_of_noise,
)
from reframe_jax.identification.freedom import SCREWS

__all__ = ["screw_probabilities", "universal_probability"]

_UNIVERSALS = 0.2  # of bodies that turn about a point in every way, as seen from both bodies
_EVENLY = 0.5  # of the others turn and slide evenly, each once
_UNKNOWN_SHARE = 0.002  # how often a screw or a universal joint shows errors of any other size


def screw_probabilities(
    rest: jax.Array,
    across: jax.Array,
    slide: tuple[jax.Array, jax.Array],
    gain: jax.Array,
    samples: jax.Array,
    share: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Probability that a slide along the axis of rotation is proportional to the turn, two times.

    On a screw, what the turn does not explain of the slide shows what a constrained axis shows: noise, slow
    errors, or what an error of measured rotation does through the pitch. In a cylinder joint it has a motion
    of its own, of any share of the slide, which may be so small that errors hide it. That share is also zero
    where the body turned and slid evenly, each once: such a motion says nothing, and what is uneven of it
    decides.

    Args:
        rest: (N,) what the turn does not explain of the slide, in noises.
        across: (N,) motion of the axis across itself, in noises.
        slide: (N,) the slide, and what an uneven turn explains of it, in noises.
        gain: (N,) what all of the measured rotation does through the pitch, in noises.
        samples: (N,) independent samples.
        share: (N,) see :func:`.freedom_patterns`.

    Returns:
        (N,) without doubts about even motion, and (N,) with them.
    """
    whole, uneven = slide
    seen = _of_rest(rest, across, whole, gain, samples, share)
    beyond = seen.hidden(whole)
    even = log(_EVENLY) + jnp.minimum(seen.hidden(uneven), 0)
    return seen.probability(SCREWS, beyond), seen.probability(SCREWS, jnp.logaddexp(beyond, even))


def universal_probability(
    change: jax.Array,
    slide: jax.Array,
    least: jax.Array,
    turn: jax.Array,
    samples: jax.Array,
    share: jax.Array,
) -> jax.Array:
    """Probability that a body that turns about a point does so about two axes, one of each body, alone.

    In a universal joint the angle between these axes changes by errors only. In a spherical joint it has a
    motion of its own, of any share of that about the axis that turns least.

    Args:
        change: (N,) of the angle, in noises.
        slide: (N,) motion of the point, in noises.
        least: (N,) rotation about the axis that turns least, in noises.
        turn: (N,) all of the rotation, in noises.
        samples: (N,) independent samples.
        share: (N,) see :func:`.freedom_patterns`.
    """
    seen = _of_rest(change, slide, least, turn, samples, share)
    return seen.probability(_UNIVERSALS, seen.hidden(least))


class _Rest(NamedTuple):
    """Densities of what a joint does not explain of a motion, in logarithms, for every size of errors.

    Attributes:
        errors: (M, N) if it is an error of that size.
        joint: (M, N) if the joint explains the motion.
        own: (1, N) if it is a motion of its own.
        seen: (M, N) weights of the sizes, as another axis that is constrained shows them.
        multiples: (M, 1) or (M, N), logarithms of the sizes.
    """

    errors: jax.Array
    joint: jax.Array
    own: jax.Array
    seen: jax.Array
    multiples: jax.Array

    def hidden(self, whole: jax.Array) -> jax.Array:
        """Logarithm of the probability that errors hide a motion of its own of a motion (N,), in noises."""
        return 2 * UNRELATED * (self.multiples - jnp.log(jnp.maximum(whole, 1e-6))[None])

    def probability(self, prior: float, hidden: jax.Array) -> jax.Array:
        """Probability of the joint, (N,), from one before any data are seen."""
        free = jnp.logaddexp(self.errors + jnp.minimum(hidden, 0), self.own)
        terms = log(prior) + self.joint + self.seen, log(1 - prior) + free + self.seen
        first, second = (nn.logsumexp(term, axis=0) for term in terms)
        return nn.sigmoid(first - second)


def _of_rest(
    rest: jax.Array,
    beside: jax.Array,
    whole: jax.Array,
    gain: jax.Array,
    samples: jax.Array,
    share: jax.Array,
) -> _Rest:
    """Judge what a joint does not explain of a motion.

    Args:
        rest: (N,) in noises.
        beside: (N,) motion along another axis that is constrained, in noises.
        whole: (N,) the motion, in noises.
        gain: (N,) what an error of all of the measured rotation would make of it, in noises.
        samples: (N,) independent samples.
        share: (N,) see :func:`.freedom_patterns`.
    """
    y, side, most = (jnp.log(jnp.maximum(x, 1e-6)) for x in (rest, beside, whole))
    sizes, spread = error_sizes(share, 1), spread_of_noise(samples)
    errors = of_errors(y, sizes, spread)
    seen = sizes.weights + of_errors(side, sizes, spread)
    by_rotation = of_rotation_error(y, gain) + log(ROTATION_ERROR_SHARE)
    by_rotation = jnp.where(sizes.white_only, -jnp.inf, by_rotation)
    joint = jnp.logaddexp(jnp.logaddexp(errors, by_rotation), log(_UNKNOWN_SHARE / log(LARGEST)))
    rate = 2 * UNRELATED
    own = log(rate) + rate * jnp.minimum(y - most, 0)[None]
    return _Rest(errors, joint, own, seen, sizes.multiples)
