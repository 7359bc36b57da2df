"""Which axes are free: the probability of every pattern of degrees of freedom, without thresholds.

An axis is judged by how far the motion went along it, in units of the noise propagated to it: t. The model
has two groups of axes.

- *Constrained* axes show noise (t about 1); or, with a tracker that has slow errors besides its noise, some
  multiple of the noise that is unknown but common to the recording; or, along an axis of a linear frame,
  what an error of measured rotation does at the end of the lever: a tenth of what the rotation itself does.
  If the error is in the scale of the rotation, the motion is proportional to the rotation, and the rest of it
  is as small as that of other constrained axes; free axes seldom move like that.
- *Free* axes went far: t is unknown but of one order of magnitude for all of them, and clearly larger than
  what constrained axes show; unless the noise is as large as the motion and hides it. How large the motion
  is, people's habits and the other free axes of the frame tell.

The unknowns are summed over with the priors below, and so are the patterns: the first axes of each frame,
sorted by velocity, are the constrained ones, so there are 4 x 4. How fast somebody moved plays no part.

The priors hold for kinds of recordings, not for single ones: noise alone, two times of three; else slow
errors of 2 to 64 noises, the larger the rarer; constraints with a name before those without. Which of the two
a recording has is then up to its constrained axes: each that shows noise alone speaks against slow errors.
"""

from math import log, pi
from typing import NamedTuple

import jax
import numpy as np

from reframe_jax.arrays import jnp, nn, norm
from reframe_jax.identification.error_model import (
    LARGEST,
    ROTATION_ERROR_SHARE,
    UNRELATED,
    ErrorSizes,
    error_sizes,
    log_normal,
    of_errors,
    of_noise,
    of_rotation_error,
    of_slow_errors,
    spread_of_noise,
)

__all__ = ["PATTERN_PRIOR", "SCREWS", "Slide", "freedom_patterns"]

PATTERN_PRIOR = np.full((4, 4), 0.1)
"""Weight of every pattern (free rotations, free translations) before any data are seen."""
for _pattern, _weight in (
    ((0, 0), 0.1),
    ((0, 1), 2.0),
    ((1, 0), 2.0),
    ((1, 1), 1.0),
    ((1, 2), 0.5),
    ((2, 0), 0.3),
    ((3, 0), 1.0),
    ((3, 1), 1.0),
    ((3, 2), 1.0),
    ((3, 3), 1.0),
):
    PATTERN_PRIOR[_pattern] = _weight

SCREWS = 0.3
"""Share of bodies that turn and slide about one axis that are on a screw."""

_SCALE_SHARE = 0.1  # how often constrained axes show an error of scale
_NOT_LESS = log(1e-12) / 2  # that part, in logarithms
_TOO_EXACT, _FAR = log(0.2), log(1e3)  # noises that the rest has at least, with an error of scale, and far
_FREE_SPREAD = 1.2  # of free axes about their common size
_LEAST = log(3.5), log(8.0)  # noises that a free axis goes at least, without slow errors and with them
_LEAST_WIDTH = 0.25
_PITCHES = log(1000.0)  # range of pitches
_USUAL, _USUAL_SPREAD = (0.3, 0.05), 1.3  # rad and m that people move things, and its logarithm's spread
_APART, _APART_WIDTH = 2.3, 0.4  # between free axes and slow errors
_SIZES = log(LARGEST / 4)  # range of the sizes of free motion
_TILT_SHARE = 0.5  # of recordings, those whose axis of rotation is tilted by slow errors and nothing else
_TILT_SPREAD = 0.8  # of the logarithm of a tilt by slow errors below the noise


class Slide(NamedTuple):
    """Motion along the last linear axis where that is the axis of rotation.

    Attributes:
        unexplained: (...) logarithm of what is left of it after the part that is proportional to the turn, as
            a share of it; 0 where that is not the axis.
        tilted: (...) the motion, over what the noise of a pose makes of the body's path if it tilts the axis.
        across_plane: (...) motion of the body across the plane nearest to its path, in noises.
    """

    unexplained: jax.Array
    tilted: jax.Array
    across_plane: jax.Array


def freedom_patterns(
    distance: jax.Array,
    noise: jax.Array,
    gain: jax.Array,
    of_turn: jax.Array,
    samples: jax.Array,
    share: jax.Array,
    at_rest: tuple[jax.Array, jax.Array],
    slide: Slide | None = None,
) -> jax.Array:
    """Probability of every pattern of degrees of freedom.

    Args:
        distance: (6, ...) how far the motion went along the axes of the angular frame, then of the linear
            frame, over the noise propagated to them; axes in the order in which they become free.
        noise: (6, ...) rad and m, that noise.
        gain: (3, ...) what all of the measured rotation makes at the end of the lever, along linear axes, in
            noises.
        of_turn: (3, ...) share of the motion along linear axes that is proportional to the rotation.
        samples: (...) independent samples.
        share: (...) of the noise of single poses that averaging has left. Slow errors are of the order of the
            noise of single poses, and averaging leaves them as they are.
        at_rest: what takes the place of the linear part of ``distance`` and ``noise`` in patterns without
            rotation, (3, ...) each, alike for all types: such a body has no origin, and moves as any of its
            points does. Seen from a distant origin, the noise of the orientation would hide that.
        slide: along the axis of rotation; None where that is not known.

    Returns:
        (4, 4, ...): n free rotations and m free translations at [n, m].
    """
    dtype = distance.dtype
    # what the logarithms hold needs no more than float32, in which there are thousands of densities a window
    y, noise, resting, resting_noise, unexplained, gain, samples, share = (
        x.astype(jnp.float32)
        for x in (
            jnp.log(jnp.clip(distance, 1e-6, LARGEST)),
            jnp.log(noise),
            jnp.log(jnp.clip(at_rest[0], 1e-6, LARGEST)),
            jnp.log(at_rest[1]),
            jnp.log(jnp.maximum(1 - of_turn, 1e-30)) / 2,
            gain,
            samples,
            share,
        )
    )
    slide = None if slide is None else Slide(*(x.astype(jnp.float32) for x in slide))
    # one more axis in front: the multiples
    sizes, spread = error_sizes(share, y.ndim), spread_of_noise(samples)[None]
    own_at_rest = of_errors(resting, sizes, spread)
    constrained = _of_constrained(y, sizes, spread, gain, unexplained, slide)
    plain, scaled = (_over_patterns(densities, own_at_rest, 1, free=False) for densities in constrained)
    # (M, 4, 4, ...): an error of scale is one of the angle about a single axis
    held = jnp.concatenate([plain[:, :1], scaled[:, 1:2], plain[:, 2:]], axis=1)
    number = jnp.asarray([[a + b for b in range(4)] for a in range(4)], y.dtype)
    number = number.reshape(4, 4, *([1] * (y.ndim - 1)))
    count = jnp.maximum(number, 1)
    total = _over_patterns(y, resting, 0, free=True)
    squares = _over_patterns(jnp.square(y), jnp.square(resting), 0, free=True)
    multiples, white_only, weights = sizes
    least = jnp.where(white_only, _LEAST[0], _LEAST[1] - jnp.log(share)[None, None])
    beyond, beyond_at_rest = (nn.log_sigmoid((x[None] - least) / _LEAST_WIDTH) for x in (y, resting))
    far = _over_patterns(beyond, beyond_at_rest, 1, free=True)
    size = total / count
    scatter = jnp.maximum(squares - count * jnp.square(size), 0)
    # free axes of a common size, over which is summed: a Gaussian integral
    width = (2 * pi) ** 0.5 * _FREE_SPREAD
    alike = -scatter / (2 * _FREE_SPREAD**2) - (number - 1) * log(width) - jnp.log(count) / 2 - log(_SIZES)
    if slide is not None:
        one = np.arange(4) == 1
        of_hinges, of_screws = (np.outer(one, x).reshape(number.shape) for x in (np.arange(4) == 0, one))
        tilted = _of_tilted(y, sizes, spread, slide)[:, None, None]
        held = jnp.where(of_hinges[None], jnp.logaddexp(held, tilted), held)
        # a screw of any pitch slides any part of what it turns
        pitched = jnp.logaddexp(log(1 - SCREWS) + alike[1, 1], log(SCREWS / (_PITCHES * _SIZES)))
        on_axis = (slide.unexplained < 0)[None, None]
        alike = jnp.where(of_screws & on_axis, pitched[None, None], alike)
    multiples, white_only = multiples[:, None], white_only[:, None]
    apart = nn.log_sigmoid((size[None] - multiples - _APART) / _APART_WIDTH)
    free = far + alike[None] + jnp.where(white_only, 0, apart)
    terms = held + weights[:, 0, None, None] + jnp.where(number[None] == 0, 0, free)
    evidence = nn.logsumexp(terms, axis=0)
    seen = jnp.exp(evidence - jnp.max(evidence, axis=(0, 1), keepdims=True))
    prior = jnp.asarray(PATTERN_PRIOR, y.dtype).reshape(number.shape)
    hidden = [
        _hidden(*group)
        for group in (
            (y[:3], noise[:3], _USUAL[0]),
            (y[3:], noise[3:], _USUAL[1]),
            (resting, resting_noise, _USUAL[1]),
        )
    ]
    weighted = (prior * _with_hidden(seen, *hidden)).astype(dtype)
    return weighted / jnp.sum(weighted, axis=(0, 1), keepdims=True)


def _of_constrained(
    y: jax.Array,
    sizes: ErrorSizes,
    spread: jax.Array,
    gain: jax.Array,
    unexplained: jax.Array,
    slide: Slide | None,
) -> tuple[jax.Array, jax.Array]:
    """Logarithm of the density of the motion along constrained axes, (M, 6, ...), for each kind of errors.

    Without errors in the scale of the measured rotation, and with them.

    Args:
        y: (6, ...) logarithm of the motion, in noises.
        sizes: of errors.
        spread: (1, ...) standard deviation of the logarithm of noise alone.
        gain: (3, ...) what all of the measured rotation makes at the end of the lever, in noises.
        unexplained: (3, ...) logarithm of what is left of the motion without what the rotation explains.
        slide: along the axis of rotation.
    """
    white_only = sizes.white_only
    own, along = of_errors(y, sizes, spread), y[3:]
    of_lever = of_rotation_error(along, gain)
    rest = jnp.maximum(unexplained, _NOT_LESS)
    usual = log(2 * UNRELATED) + 2 * UNRELATED * rest  # density of the rest if nothing relates the two
    by_scale = of_lever + of_errors(along + rest, sizes, spread) - usual[None]
    # no sensor is as exact as that
    exact = along + unexplained < _TOO_EXACT
    by_scale = jnp.where(exact & (along > _FAR), -jnp.inf, by_scale)
    lever_share = jnp.where(white_only, 0, ROTATION_ERROR_SHARE)
    by_rotation = jnp.where(white_only, -jnp.inf, of_lever + log(ROTATION_ERROR_SHARE))

    def in_proportion(density: jax.Array, rest: jax.Array) -> jax.Array:
        """Along the axis of rotation errors, but for noise, are seldom proportional to the turn."""
        exact = (along[2] + rest < _TOO_EXACT) & (along[2] > _FAR)
        seldom = jnp.where(exact, -jnp.inf, log(_SCALE_SHARE))
        seldom = jnp.logaddexp(seldom, log(2 * UNRELATED) + 2 * UNRELATED * rest)
        silent = of_noise(along[2], spread[0], white_only[:, 0])
        seldom = jnp.where(rest < 0, jnp.minimum(seldom, 0), 0)[None]
        return jnp.where(rest[None] < 0, jnp.logaddexp(density + seldom, silent), density)

    def of_all(scale_share: float) -> jax.Array:
        linear = jnp.logaddexp(own[:, 3:] + jnp.log(1 - scale_share - lever_share), by_rotation)
        if scale_share:
            linear = jnp.logaddexp(linear, by_scale + log(scale_share))
        if slide is not None:
            third = in_proportion(linear[:, 2], slide.unexplained)
            linear = jnp.concatenate([linear[:, :2], third[:, None]], axis=1)
        return jnp.concatenate([own[:, :3], linear], axis=1)

    return of_all(0.0), of_all(_SCALE_SHARE)


def _of_tilted(y: jax.Array, sizes: ErrorSizes, spread: jax.Array, slide: Slide) -> jax.Array:
    """Logarithm of the density of a hinge whose slow errors tilt the axis that is seen, (M, ...).

    What slow errors do in proportion to the motion looks like a motion about another axis, and they show
    along no axis but that of rotation: there a body seems to slide that moves in a plane. A body that slides
    leaves the plane, by any share of what it slides.

    Args:
        y: (6, ...) logarithm of the motion, in noises.
        sizes: of errors.
        spread: (1, ...) standard deviation of the logarithm of noise alone.
        slide: along the axis of rotation.
    """
    tilted, across = (jnp.log(jnp.clip(x, 1e-6, LARGEST))[None] for x in slide[1:])
    others = jnp.concatenate([y[:2], y[3:5]])
    silent = jnp.sum(log_normal(jnp.maximum(others, 0), 0.0, spread), axis=0)
    usual = log(2 * UNRELATED) + 2 * UNRELATED * jnp.minimum(across - y[5:], 0)
    in_plane = of_errors(across, sizes, spread) - usual[None]
    # errors below the noise are slow ones as well
    tilt = jnp.where(sizes.white_only, of_noise(tilted, _TILT_SPREAD, True), of_slow_errors(tilted, sizes))
    # what they do besides the tilt is below the noise, along all other axes
    alone = log(_TILT_SHARE) - 2 * UNRELATED * jnp.maximum(tilted[0], 0)
    density = tilt[:, 0] + in_plane[:, 0] + (alone + silent)[None]
    return jnp.where((slide.unexplained < 0)[None], density, -jnp.inf)


def _hidden(y: jax.Array, noise: jax.Array, usual: float) -> jax.Array:
    """Probability that a free axis shows nothing but noise, (3, ...): noise as large as its motion is.

    Its motion is as large as usual, and as that of the largest free axis of its frame where one is seen.

    Args:
        y: (3, ...) logarithm of the motion along the axes of a frame, in noises.
        noise: (3, ...) logarithm of the noise, in rad or m.
        usual: rad or m, the usual motion.
    """
    largest = jnp.max(y, axis=0)[None]
    seen = nn.sigmoid((largest - _LEAST[0]) / _LEAST_WIDTH)
    by_habit, alike = 1 / _USUAL_SPREAD**2, seen / _FREE_SPREAD**2
    size = (by_habit * (log(usual) - noise) + alike * largest) / (by_habit + alike)
    below = (_LEAST[0] - size) * jnp.sqrt(by_habit + alike)
    return norm.cdf(below) * nn.sigmoid((_LEAST[0] - y) / _LEAST_WIDTH)


def _with_hidden(seen: jax.Array, angular: jax.Array, linear: jax.Array, at_rest: jax.Array) -> jax.Array:
    """Likelihood of every pattern, (4, 4, ...), from that of the axes that are seen to be free.

    Args:
        seen: (4, 4, ...).
        angular: (3, ...) see :func:`_hidden`.
        linear: (3, ...) likewise.
        at_rest: (3, ...) likewise, of linear axes in patterns without rotation.
    """
    at_rest = jnp.broadcast_to(at_rest, linear.shape)
    for group, hidden in enumerate((angular[:, None], jnp.stack([at_rest, linear, linear, linear], axis=1))):
        x = jnp.moveaxis(seen, group, 0)
        rows = [x[0]]
        for free in range(1, 4):
            # the last axis that became free is seen, or hidden behind as many as are seen without it
            rows.append(x[free] + hidden[3 - free] * rows[-1])
        seen = jnp.moveaxis(jnp.stack(rows), 0, group)
    return seen


def _over_patterns(values: jax.Array, at_rest: jax.Array, axis: int, free: bool) -> jax.Array:
    """Sums over the axes that are free in every pattern, or over those that are not.

    Args:
        values: six of them along an axis: three of the angular frame, three of the linear one.
        at_rest: the linear ones in patterns without rotation.
        axis: that axis; two of size 4 take its place.
        free: which to add up; the last axes of each frame become free first.
    """
    x, still = jnp.moveaxis(values, axis, 0), jnp.moveaxis(at_rest, axis, 0)
    sums = []
    for group in (x[:3], x[3:], jnp.broadcast_to(still, x[3:].shape)):
        zero = jnp.zeros_like(group[:1])
        if free:
            sums.append(jnp.concatenate([zero, jnp.cumsum(group[::-1], axis=0)]))
        else:
            sums.append(jnp.concatenate([zero, jnp.cumsum(group, axis=0)])[::-1])
    angular, linear, resting = sums
    of_linear = jnp.stack([resting, linear, linear, linear])
    return jnp.moveaxis(angular[:, None] + of_linear, (0, 1), (axis, axis + 1))
