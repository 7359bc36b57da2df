"""Keep large programs between processes.

JAX's compilation cache keeps machine code, but finds it only after Python has traced the function, which
takes longer than to load the code. Each :class:`reframe_jax.compilation.Program` is therefore also kept
before compilation, by :mod:`jax.export`: a later process does not trace it.
"""

import glob
import hashlib
import importlib.util
import inspect
import os
import pickle
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import jax

_UNREADABLE = r"Error reading persistent compilation cache entry for '([^']+)'"
_FLATBUFFERS = importlib.util.find_spec("flatbuffers") is not None
_folder: Path | None = None


def cache_programs(folder: str | os.PathLike[str] | None = None) -> Path:
    """Keep compiled programs in a folder, so that the first answer of later processes takes seconds less.

    Call it once, before the first computation. It sets JAX's compilation cache to the folder, for all
    programs of the process. With the package flatbuffers (``pip install reframe-jax[cache]``), the programs
    of :func:`reframe_jax.identify` and of error bars are kept before compilation too, and need no tracing. A
    change of the library, of JAX or of the compiler leads to new files; delete the folder to delete all.

    Args:
        folder: is made if it does not exist. By default ``reframe_jax`` in the folder of the environment
            variable ``XDG_CACHE_HOME``, or in ``~/.cache``.

    Returns:
        The folder.
    """
    global _folder
    default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "reframe_jax"
    chosen = default if folder is None else Path(folder)
    _replace_unreadable(chosen)
    settings: dict[str, Any] = {
        "jax_compilation_cache_dir": str(chosen),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in settings.items():
        jax.config.update(name, value)  # type: ignore[no-untyped-call]
    _folder = chosen
    return chosen


def can_keep(static: dict[str, Any]) -> bool:
    """Whether the program of a function with these static arguments is kept before compilation.

    Code that is not part of the library, such as that of a user's solver, may change without a change of its
    name: its programs are not kept.
    """
    return _folder is not None and _FLATBUFFERS and all(map(_is_plain, static.values()))


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    if inspect.isfunction(value):
        return value.__module__.startswith("reframe_jax.") and "<" not in value.__qualname__
    return value is None or isinstance(value, bool | int | float | str)


def load_or_export(
    function: Callable[..., Any], arguments: tuple[Any, ...], static: dict[str, Any]
) -> Callable[..., Any]:
    """Return a function of pytrees of arrays as a program from the folder, or traced and written there.

    The arguments are shapes; the static arguments must be such that :func:`can_keep` holds.
    """
    leaves, tree = jax.tree.flatten(arguments)
    platform = "cuda" if jax.default_backend() == "gpu" else jax.default_backend()
    shapes = [(leaf.shape, str(leaf.dtype)) for leaf in leaves]
    functions = {k: f"{v.__module__}.{v.__qualname__}" for k, v in static.items() if inspect.isfunction(v)}
    name = function.__module__, function.__qualname__
    wide = jax.dtypes.canonicalize_dtype(float).name
    what = _version(), platform, wide, name, shapes, str(tree), sorted({**static, **functions}.items())
    assert _folder is not None
    file = _folder / "programs" / hashlib.sha256(repr(what).encode()).hexdigest()
    kept = _read(file)
    if kept is None:
        shape_of: list[Any] = []

        def of_leaves(*leaves: Any) -> list[Any]:
            out = function(*jax.tree.unflatten(tree, leaves), **static)
            found, structure = jax.tree.flatten(out)
            shape_of.append(jax.tree.unflatten(structure, range(len(found))))
            return found

        exported = jax.export.export(jax.jit(of_leaves), platforms=[platform])(*leaves)
        kept = bytes(exported.serialize()), shape_of[-1]
        _write(file, kept)
    program, results = jax.export.deserialize(bytearray(kept[0])), kept[1]

    def call(*arguments: Any) -> Any:
        found = program.call(*jax.tree.leaves(arguments))
        return jax.tree.map(found.__getitem__, results)

    return call


@cache
def _version() -> str:
    """Digest of the sources of the library, with the version of JAX."""
    digest = hashlib.sha256(jax.__version__.encode())
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _read(file: Path) -> tuple[bytes, Any] | None:
    """Read a kept program; None if the file is missing or damaged."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    digest, content = content[:32], content[32:]
    return pickle.loads(content) if hashlib.sha256(content).digest() == digest else None


def _write(file: Path, kept: tuple[bytes, Any]) -> None:
    """Write a file in one step; a folder in which nothing can be written only costs time later."""
    content = pickle.dumps(kept)
    part = file.with_name(f"{file.name}.{os.getpid()}")
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(hashlib.sha256(content).digest() + content)
        part.replace(file)


def _replace_unreadable(folder: Path) -> None:
    """Delete cache entries that JAX reports as unreadable, because JAX does not overwrite them."""
    default_handler = warnings.showwarning

    def delete_or_print(message: Warning | str, *about: Any, **more: Any) -> None:
        unreadable = re.match(_UNREADABLE, str(message))
        if unreadable is None:
            default_handler(message, *about, **more)
            return
        for file in folder.glob(glob.escape(unreadable[1]) + "-*"):
            file.unlink(missing_ok=True)

    warnings.showwarning = delete_or_print  # type: ignore[assignment]
