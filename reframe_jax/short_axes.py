"""Reductions over short axes, written out: ``x[0] + x[1] + x[2]`` for ``jnp.sum(x, axis=0)``.

XLA makes a function of its own for every reduction, and on a processor it allocates memory for each value in
it whenever a program starts: 0.07 us each, and the programs for a window had 3,000 of them. What is written
out is part of the arithmetic around it. Its derivatives are larger, so this is for programs that have none.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["ShortAxes"]

_LONGEST = 16  # numbers that a reduction is written out for


def _axes_of(x: jax.Array, axis: int | tuple[int, ...] | None) -> tuple[int, ...]:
    return tuple(range(x.ndim)) if axis is None else tuple(np.atleast_1d(axis) % x.ndim)


def _written_out(
    reduction: Callable[..., jax.Array], combine: Callable[[jax.Array, jax.Array], jax.Array], kinds: str
) -> Callable[..., jax.Array]:
    """A reduction of ``jax.numpy``, written out for short axes of arrays of these kinds of numbers."""

    def reduced(
        x: jax.Array,
        axis: int | tuple[int, ...] | None = None,
        dtype: Any = None,
        keepdims: bool = False,
    ) -> jax.Array:
        x = jnp.asarray(x)
        axes = _axes_of(x, axis)
        lengths = [x.shape[i] for i in axes]
        usual = x.dtype.kind in kinds or dtype is not None
        if not usual or not 0 < math.prod(lengths) <= _LONGEST:
            return reduction(x, axis=axis, keepdims=keepdims, **({} if dtype is None else {"dtype": dtype}))
        x = x if dtype is None else x.astype(dtype)
        total: Any = None
        for place in itertools.product(*map(range, lengths)):
            part = x
            for i, at in zip(axes, place, strict=True):
                part = jax.lax.slice_in_dim(part, at, at + 1, axis=i)
            total = part if total is None else combine(total, part)
        found: jax.Array = total if keepdims else jax.lax.squeeze(total, axes)
        return found

    return reduced


def _first_place(
    reduction: Callable[..., jax.Array], wins: Callable[[jax.Array, jax.Array], jax.Array]
) -> Callable[..., jax.Array]:
    """``argmax`` or ``argmin``: the first place of the best number, or of NaN."""

    def place_of(x: jax.Array, axis: int | None = None) -> jax.Array:
        if axis is None or not 0 < x.shape[axis] <= _LONGEST:
            return reduction(x, axis=axis)
        best = jax.lax.index_in_dim(x, 0, axis, keepdims=False)
        place = jnp.zeros(best.shape, jax.dtypes.canonicalize_dtype(np.int64))
        for i in range(1, x.shape[axis]):
            part = jax.lax.index_in_dim(x, i, axis, keepdims=False)
            better = wins(part, best) | ((part != part) & (best == best))
            best, place = jnp.where(better, part, best), jnp.where(better, i, place)
        return place

    return place_of


_sum = _written_out(jnp.sum, jnp.add, "f")


def _mean(
    x: jax.Array, axis: int | tuple[int, ...] | None = None, dtype: Any = None, keepdims: bool = False
) -> jax.Array:
    if x.dtype.kind != "f" or dtype is not None:
        return jnp.mean(x, axis=axis, dtype=dtype, keepdims=keepdims)
    return _sum(x, axis=axis, keepdims=keepdims) / math.prod(x.shape[i] for i in _axes_of(x, axis))


class ShortAxes:
    """``jax.numpy`` with reductions over short axes written out."""

    sum = staticmethod(_sum)
    mean = staticmethod(_mean)
    max = staticmethod(_written_out(jnp.max, jnp.maximum, "fi"))
    min = staticmethod(_written_out(jnp.min, jnp.minimum, "fi"))
    any = staticmethod(_written_out(jnp.any, jnp.logical_or, "b"))
    all = staticmethod(_written_out(jnp.all, jnp.logical_and, "b"))
    argmax = staticmethod(_first_place(jnp.argmax, jnp.greater))
    argmin = staticmethod(_first_place(jnp.argmin, jnp.less))

    def __getattr__(self, name: str) -> Any:
        return getattr(jnp, name)
