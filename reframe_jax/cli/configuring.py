"""JAX settings of the command line."""

import glob
import os
import re
import warnings
from pathlib import Path
from typing import Any

import jax

from reframe_jax.compilation import COMPILER_OPTIONS

__all__ = ["configure_jax"]

_FAST_COMPILATION = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters"
_UNREADABLE = r"Error reading persistent compilation cache entry for '([^']+)'"


def configure_jax(cache: bool) -> None:
    """Enable 64-bit mode, and keep compiled programs between runs, unless ``REFRAME_JAX_CACHE=0``."""
    flags = os.environ.get("XLA_FLAGS", "")
    if COMPILER_OPTIONS is None and "xla_backend_extra_options" not in flags:
        # the same option for all programs; the compiler reads it when it starts
        os.environ["XLA_FLAGS"] = f"{flags} {_FAST_COMPILATION}".strip()
    settings: dict[str, Any] = {"jax_enable_x64": True}
    if cache and os.environ.get("REFRAME_JAX_CACHE") != "0":
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "reframe_jax"
        _replace_unreadable(folder)
        settings["jax_compilation_cache_dir"] = str(folder)
        settings["jax_persistent_cache_min_compile_time_secs"] = 0.0
        settings["jax_persistent_cache_min_entry_size_bytes"] = -1
    for name, value in settings.items():
        jax.config.update(name, value)  # type: ignore[no-untyped-call]


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
