"""The array functions that identification is written in: JAX's, or NumPy's where nothing is to be compiled.

To compile a search takes many seconds; to compute it for one window, one operation after the other, takes a
twentieth of one. Modules that identify take ``jnp``, ``lax`` and the rest from here instead of from JAX.
Within :func:`with_numpy` these are NumPy functions that compute at once; everywhere else they are JAX's. In
our own programs for a processor, ``jnp`` writes out short reductions, see :mod:`.short_axes`.

Functions in which NumPy differs from JAX are listed below. Code that runs on both has four rules: no
``.at``, but :func:`put` and :func:`add`; no index out of range; nothing that asks whether an array is a
``jax.Array``; no derivative, whose rules are those of JAX.
"""

import contextlib
import math
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import partial
from operator import itemgetter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import numpy as np

from reframe_jax.short_axes import ShortAxes

__all__ = [
    "add",
    "custom_jvp",
    "jnp",
    "lax",
    "linalg",
    "nn",
    "norm",
    "put",
    "random",
    "tracing",
    "using_numpy",
    "vmap",
    "with_numpy",
]

_T = TypeVar("_T")
_numpy: ContextVar[bool] = ContextVar("_numpy", default=False)

tracing = jax.make_user_context("")
"""What is being traced: "" anything, "program" one of our own for a CPU, "kernel" a kernel of such a program,
"gpu" a kernel for a GPU. JAX keeps what it traced in each apart."""


def using_numpy() -> bool:
    """Whether array functions are NumPy's, in this thread."""
    return _numpy.get()


@contextlib.contextmanager
def with_numpy() -> Iterator[None]:
    """Compute with NumPy, in this thread; without warnings of division by zero and the like, as JAX does."""
    token = _numpy.set(True)
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        _numpy.reset(token)


def put(array: _T, index: Any, values: Any) -> _T:
    """The array with other values at an index."""
    if not using_numpy():
        return array.at[index].set(values)  # type: ignore[attr-defined]
    changed: Any = np.array(array)
    changed[index] = values
    return changed


def add(array: _T, index: Any, values: Any) -> _T:
    """The array with values added at an index."""
    if not using_numpy():
        return array.at[index].add(values)  # type: ignore[attr-defined]
    changed: Any = np.array(array)
    changed[index] += values
    return changed


def _cond(condition: Any, if_true: Callable[..., _T], if_false: Callable[..., _T], *operands: Any) -> _T:
    return (if_true if condition else if_false)(*operands)


def _fori_loop(lower: Any, upper: Any, body: Callable[[Any, _T], _T], value: _T) -> _T:
    for i in range(int(lower), int(upper)):
        value = body(np.int32(i), value)
    return value


def _while_loop(goes_on: Callable[[_T], Any], body: Callable[[_T], _T], value: _T) -> _T:
    while goes_on(value):
        value = body(value)
    return value


def _scan(body: Callable[..., Any], carry: Any, xs: Any = None, length: int | None = None) -> tuple[Any, Any]:
    rows = []
    for i in range(len(jax.tree.leaves(xs)[0]) if length is None else length):
        carry, row = body(carry, jax.tree.map(lambda x, i=i: x[i], xs))
        rows.append(row)
    return carry, jax.tree.map(lambda *parts: np.stack(parts), *rows)


def _running(function: np.ufunc, x: np.ndarray, axis: int = 0, reverse: bool = False) -> np.ndarray:
    if reverse:
        return np.flip(function.accumulate(np.flip(x, axis), axis=axis), axis)
    return function.accumulate(x, axis=axis)


def _reduce_precision(x: np.ndarray, exponent_bits: int, mantissa_bits: int) -> np.ndarray:
    single = np.finfo(np.float32)
    if (exponent_bits, mantissa_bits) != (single.nexp, single.nmant):
        raise NotImplementedError("with NumPy, precision is reduced to that of float32 only")
    return x.astype(np.float32).astype(x.dtype)


def _vmap(function: Callable[..., Any], in_axes: Any = 0, out_axes: int = 0) -> Callable[..., Any]:
    def of_all(*arguments: Any) -> Any:
        axes = in_axes if isinstance(in_axes, tuple) else (in_axes,) * len(arguments)
        count = next(
            leaf.shape[axis]
            for argument, axis in zip(arguments, axes, strict=True)
            for leaf in jax.tree.leaves(argument)
            if axis is not None
        )

        def of_one(i: int) -> Any:
            taken = (
                argument if axis is None else jax.tree.map(itemgetter((*[slice(None)] * axis, i)), argument)
                for argument, axis in zip(arguments, axes, strict=True)
            )
            return function(*taken)

        return jax.tree.map(lambda *parts: np.stack(parts, axis=out_axes), *map(of_one, range(count)))

    return of_all


def _matmul(a: np.ndarray, b: np.ndarray, precision: Any = None) -> np.ndarray:
    return np.matmul(a, b)


def _nanmedian(x: np.ndarray, axis: int | None = None) -> np.ndarray:
    """NaN where there is nothing but NaN, of which NumPy would warn."""
    x, axis = (x.ravel(), 0) if axis is None else (x, axis)
    x = np.sort(x, axis=axis)  # NaN last
    count = np.sum(~np.isnan(x), axis=axis, keepdims=True)
    middle = [np.take_along_axis(x, np.maximum(n, 0), axis=axis) for n in ((count - 1) // 2, count // 2)]
    middle[1] = np.where(count == 0, np.nan, middle[1])
    return np.squeeze((middle[0] + middle[1]) / 2, axis=axis)


def _softmax(x: np.ndarray, axis: int) -> np.ndarray:
    powers = np.exp(x - np.max(x, axis=axis, keepdims=True))
    return powers / np.sum(powers, axis=axis, keepdims=True)


def _log_sigmoid(x: np.ndarray) -> np.ndarray:
    return -np.logaddexp(0, -x)


_erfc = np.vectorize(math.erfc, otypes=[float])


def _normal_cdf(x: np.ndarray) -> np.ndarray:
    return (_erfc(-x / math.sqrt(2)) / 2).astype(x.dtype)


def _or_nan(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of matrices (..., n, n) with NaN for those that it refuses, as JAX has it."""

    def of_all(*matrices: np.ndarray) -> Any:
        try:
            return function(*matrices)
        except np.linalg.LinAlgError:
            batch = np.broadcast_shapes(*(matrix.shape[:-2] for matrix in matrices))
            if not batch:
                like = function(
                    *(np.broadcast_to(np.eye(*m.shape[-2:], dtype=m.dtype), m.shape) for m in matrices)
                )
                return jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), like)
            each = [np.broadcast_to(matrix, (*batch, *matrix.shape[-2:])) for matrix in matrices]
            found = [of_all(*(matrix[i] for matrix in each)) for i in np.ndindex(batch)]
            return jax.tree.map(lambda *parts: np.stack(parts).reshape(*batch, *parts[0].shape), *found)

    return of_all


def _solve_triangular(root: np.ndarray, x: np.ndarray, lower: bool, trans: int = 0) -> np.ndarray:
    found: np.ndarray = _or_nan(np.linalg.solve)(np.swapaxes(root, -1, -2) if trans else root, x)
    return found


def _drawn(draw: Callable[..., jax.Array]) -> Callable[..., np.ndarray]:
    """The same numbers as a search that is compiled draws."""
    return lambda *arguments, **options: np.asarray(draw(*arguments, **options))


class _Either:
    """Functions of a module of JAX, or within :func:`with_numpy` those of the same names for NumPy.

    Others may take the place of the former in our own programs for a processor.
    """

    def __init__(self, of_jax: Any, of_numpy: Any, in_programs: Any = None) -> None:
        self._of_jax, self._of_numpy = of_jax, of_numpy
        self._in_programs = of_jax if in_programs is None else in_programs

    def __getattr__(self, name: str) -> Any:
        if _numpy.get():
            return getattr(self._of_numpy, name)
        return getattr(self._in_programs if tracing.value in ("program", "kernel") else self._of_jax, name)


class _NumPy:
    """NumPy, and what of JAX's NumPy it has otherwise."""

    linalg = SimpleNamespace(
        cholesky=_or_nan(np.linalg.cholesky),
        eigh=_or_nan(np.linalg.eigh),
        norm=np.linalg.norm,
        solve=_or_nan(np.linalg.solve),
    )
    matmul = staticmethod(_matmul)
    nanmedian = staticmethod(_nanmedian)

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


_LAX = SimpleNamespace(
    Precision=jax.lax.Precision,
    cond=_cond,
    cummax=partial(_running, np.maximum),
    cummin=partial(_running, np.minimum),
    fori_loop=_fori_loop,
    map=lambda function, xs: _vmap(function)(xs),
    reduce_precision=_reduce_precision,
    scan=_scan,
    stop_gradient=lambda x: x,
    while_loop=_while_loop,
)
_NN = SimpleNamespace(
    log_sigmoid=_log_sigmoid,
    logsumexp=np.logaddexp.reduce,
    sigmoid=lambda x: np.exp(_log_sigmoid(x)),
    softmax=_softmax,
)
_RANDOM = SimpleNamespace(
    exponential=_drawn(jax.random.exponential),
    fold_in=jax.random.fold_in,
    key=jax.random.key,
    normal=_drawn(jax.random.normal),
    split=jax.random.split,
    uniform=_drawn(jax.random.uniform),
)

if TYPE_CHECKING:
    import jax.numpy as jnp
    from jax import custom_jvp, lax, nn, random, vmap
    from jax.scipy import linalg
    from jax.scipy.stats import norm
else:
    jnp = _Either(jax.numpy, _NumPy(), ShortAxes())
    lax = _Either(jax.lax, _LAX)
    linalg = _Either(jax.scipy.linalg, SimpleNamespace(solve_triangular=_solve_triangular))
    nn = _Either(jax.nn, _NN)
    norm = _Either(jax.scipy.stats.norm, SimpleNamespace(cdf=_normal_cdf))
    random = _Either(jax.random, _RANDOM)

    def vmap(function: Callable[..., Any], **axes: Any) -> Callable[..., Any]:
        """As of JAX; with NumPy a loop."""
        return (_vmap if using_numpy() else jax.vmap)(function, **axes)

    class custom_jvp(jax.custom_jvp):  # noqa: N801
        """As of JAX; with NumPy the function itself."""

        def __call__(self, *arguments: Any) -> Any:
            """Call the function."""
            return self.fun(*arguments) if using_numpy() else super().__call__(*arguments)
