"""Draw random demonstrations repeatedly, until enough of them are feasible for the robot."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from reframe_jax.simulation.arm.status import RolloutStatus

__all__ = ["Draw", "draw_usable"]

_PATIENCE = 10  # chunks before an error, if more than 9 in 10 draws are unusable

Batch = TypeVar("Batch")


@dataclass(frozen=True)
class Draw(Generic[Batch]):
    """One chunk of draws, and its usable draws.

    Attributes:
        batch: the draws.
        good: indices of the usable draws in ``batch``; the last chunk has only as many as needed.
        first: number of the first draw of the chunk, counted over all chunks.
    """

    batch: Batch
    good: np.ndarray
    first: int


def draw_usable(
    draw: Callable[[int], tuple[Batch, np.ndarray]],
    count: int,
    chunk: int,
    *,
    subject: str = "demonstrations are usable",
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Draw[Batch]]:
    """Draw chunks until enough draws are usable; yields every chunk, including chunks without usable draws.

    Args:
        draw: function of the number of a chunk that returns the draws and the :class:`RolloutStatus` (n,) of
            each.
        count: number of usable draws to collect.
        chunk: number of draws per chunk.
        subject: end of the error message "Only 3 of 40 ..." if too few draws are usable.
        progress: function to call after every chunk, with the number of usable draws and ``count``.

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
            raise ValueError(f"Only {done} of {drawn} {subject}.{worst}")
        if progress is not None:
            progress(done, count)
        yield Draw(batch, good, first)
