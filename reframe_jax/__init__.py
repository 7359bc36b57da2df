"""Identify kinematic constraints from measured poses, in JAX.

The input is the poses of a moving body. The result is the name of the constraint with its probability, and
the constraint frame (Overbeek et al. 2025): its location, its axes, which of these axes are constrained, and
whether the frame is fixed in the ground or in the moving body.

    import reframe_jax as rf

    recording = rf.load_recording("door.csv")
    found = rf.identify(recording.poses, times=recording.times)
    print(found.name, found.linear.frame_type, found.linear.position)
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from reframe_jax._public import *  # noqa: F403
else:

    def __getattr__(name: str) -> Any:
        """Import all public names on first use, so that the command line starts without JAX."""
        if not (name.startswith("__") and name != "__all__"):
            names = vars(importlib.import_module("reframe_jax._public"))
            public = {each: value for each, value in names.items() if not each.startswith("_")}
            globals().update(public, __all__=sorted(public))
            if name in globals():
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__getattr__("__all__")})
