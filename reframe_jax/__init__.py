"""Constraint frames from measured poses, in JAX.

From the poses of a moving body alone, find the frame in which its motion is constrained: the body it
is attached to, where it lies, and along which axes the velocity is zero (Overbeek et al. 2025).

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
        """Import the public names with the first of them: the command line answers before JAX is there."""
        if not (name.startswith("__") and name != "__all__"):
            public = importlib.import_module("reframe_jax._public")
            globals().update({each: getattr(public, each) for each in public.__all__}, __all__=public.__all__)
            if name in globals():
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__getattr__("__all__")})
