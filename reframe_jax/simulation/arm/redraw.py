"""Repeated draws until enough of them are feasible for the robot."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from reframe_jax.simulation.arm.status import RolloutStatus

__all__ = ["Draw", "draw_good"]

_PATIENCE = 10  # chunks drawn before giving up, if more than 9 in 10 draws are of no use

Batch = TypeVar("Batch")


@dataclass(frozen=True)
class Draw(Generic[Batch]):
    """One chunk, and what of it counts.

    Attributes:
        batch: what was drawn.
        good: indices of the usable ones in it; of the last chunk, no more than are wanted.
        first: number of its first draw, over all chunks.
    """

    batch: Batch
    good: np.ndarray
    first: int


def draw_good(
    draw: Callable[[int], tuple[Batch, np.ndarray]],
    count: int,
    chunk: int,
    *,
    complaint: str = "demonstrations are usable",
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Draw[Batch]]:
    """Draw chunks until enough draws are good.

    Args:
        draw: given the number of a chunk, what is in it and the :class:`RolloutStatus` (n,) of each.
        count: number of good ones wanted.
        chunk: number drawn at once.
        complaint: what of so many draws, if too few are good.
        progress: called with the number of good ones so far and ``count``, after every chunk.

    Yields:
        Every chunk, those without a good one too.

    Raises:
        ValueError: if more than 9 in 10 draws are unusable and more are still needed.
    """
    done, drawn = 0, 0
    while done < count:
        batch, status = draw(drawn // chunk)
        good = np.flatnonzero(status == RolloutStatus.OK)[: count - done]
        first, drawn, done = drawn, drawn + chunk, done + len(good)
        if done < count and drawn >= _PATIENCE * chunk and done < drawn / 10:
            worst = f" {RolloutStatus(int(np.median(status))).message}" if np.any(status) else ""
            raise ValueError(f"Only {done} of {drawn} {complaint}.{worst}")
        if progress is not None:
            progress(done, count)
        yield Draw(batch, good, first)
