"""``identify`` with a given lag, where it has that argument: the paper's objective is lag 1."""

import inspect
from typing import Any

import reframe_jax as rf

__all__ = ["identify_at", "takes_lag"]


def takes_lag() -> bool:
    """Whether ``identify`` can be told how long its chords are; without that, all it knows is lag 1."""
    return "lag" in inspect.signature(rf.identify).parameters


def identify_at(lag: int, poses: Any, **options: Any) -> rf.Identification:
    """``identify`` with chords of so many samples.

    Args:
        lag: number of samples; 1 is the paper's objective.
        poses: (..., K+1, 4, 4), m.
        options: further arguments of ``identify``.

    Raises:
        ValueError: for another lag than 1, if ``identify`` does not take one.
    """
    if takes_lag():
        options["lag"] = lag
    elif lag != 1:
        raise ValueError(f"this version of identify takes no lag: it knows 1 only, not {lag}.")
    return rf.identify(poses, **options)
