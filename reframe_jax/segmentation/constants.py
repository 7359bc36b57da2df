"""Every tuned constant of segmentation, with where it comes from.

The figures behind them: sequences and single constraints of :mod:`benchmarks.segmentation_cases`, with both
kinds of motion and seeds that the benchmark does not use, and the recordings of ``../shared/data``.
"""

from typing import NamedTuple

__all__ = ["SEGMENTS", "SegmentConstants"]


class SegmentConstants(NamedTuple):
    """Constants of segmentation.

    Attributes:
        floor_position, floor_rotation: m and rad; residuals below are not distinguished from zero: the usual
            slow errors of a robot or a tracker.
        lever: m, at which a rotation counts as a translation.
        motion_time: of the lag at which the speed of displacements has halved, the time of one independent
            value; 1 / (2 B) for motion of bandwidth B.
        cells: cells in a motion time.
        held: of the motion of the recording, the most that a held coordinate may move.
        still: the same of a body that is still.
        gap: largest motion of a span over that of a coordinate which is held in it.
        reference: of the motion of the recording, the amplitude of a free coordinate that happens to move
            little: divides between held and free.
        chance: quantile of the sizes that rows reach by chance, from which evidence counts.
        usual: quantile of the paths in windows of the recording, below which a motion is slow: two in five.
        price: log evidence that a segment costs, for one of many spans and models has the largest; a model
            that lacks no more is tried, as the segment may be longer.
        border: log evidence, beside a border, of a pose that a model explains, and the same for every row:
            of one row, residuals of 2.6 times their RMS are taken for motion.
        tail: degrees of freedom of the distribution of residuals.
        widen: times that residuals of models from windows are larger: a fit to few values makes them
            too small.
        same: times that held coordinates may move more where a constraint comes back or goes on.
        pause: times that the body moves less in a pause than in the motion beside it.
        still_time: motion times that stillness takes at least to be a state; a gap within a constraint is
            shorter.
    """

    floor_position: float = 3e-4
    floor_rotation: float = 1.5e-3
    lever: float = 0.2
    motion_time: float = 0.5
    cells: float = 5.0
    held: float = 1 / 30
    still: float = 1 / 50
    gap: float = 4.0
    reference: float = 1 / 2
    chance: float = 0.2
    usual: float = 0.4
    price: float = 12.0
    border: float = 1.0
    tail: float = 4.0
    widen: float = 1.5
    same: float = 3.5
    pause: float = 3.0
    still_time: float = 1.5


SEGMENTS = SegmentConstants()
