"""JAX settings of the command line."""

import os
from pathlib import Path
from typing import Any

import jax

__all__ = ["configure_jax"]


def configure_jax(cache: bool) -> None:
    """Enable 64-bit mode and, with ``cache``, keep compiled programs between runs."""
    settings: dict[str, Any] = {"jax_enable_x64": True}
    if cache:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        settings["jax_compilation_cache_dir"] = str(Path(home) / "reframe-jax")
        settings["jax_persistent_cache_min_compile_time_secs"] = 0.0
        settings["jax_persistent_cache_min_entry_size_bytes"] = -1
    for name, value in settings.items():
        jax.config.update(name, value)  # type: ignore[no-untyped-call]
