"""Every tuned constant of segmentation, with its meaning.

The constants were tuned on sequences and single constraints of :mod:`benchmarks.segmentation_cases`, with
seeds that the benchmark does not use, and on measured recordings.
"""

from typing import NamedTuple

__all__ = ["SEGMENTS", "SegmentConstants"]


class SegmentConstants(NamedTuple):
    """Constants of segmentation.

    Attributes:
        floor_position, floor_rotation: m and rad; smaller residuals cannot be distinguished from zero,
            because of the slow errors of robots and trackers.
        lever: m, factor that converts a rotation to a translation.
        motion_time: ratio of the motion time (the time of one independent value) to the lag at which the
            speed of displacements has halved; 1 / (2 B) for a motion of bandwidth B.
        cells: number of cells per motion time.
        held: largest amplitude of a held coordinate, as a fraction of the motion of the recording.
        still: largest amplitude of a coordinate of a still body, as a fraction of the motion of the
            recording.
        gap: smallest ratio of the largest motion of a span to the motion of a coordinate that is held in it.
        reference: amplitude of a free coordinate that moves little, as a fraction of the motion of the
            recording; the evidence compares held coordinates with this amplitude.
        price: log evidence that is subtracted for each segment, in addition to the price of its parameters.
        slack: log evidence that the model of a window may lack, because the segment may be longer.
        border: log evidence of a pose next to a border that fits a model, and of each of its held
            coordinates. With one held coordinate, residuals above 2.6 times their RMS count as motion.
        tail: degrees of freedom of Student's distribution of the residuals.
        widen: factor on the residuals of models from windows, which are too small if a window has few values.
        same: factor by which held coordinates may move more where a constraint recurs or continues.
        pause: smallest ratio of the motion next to a pause to the motion in the pause.
        still_time: shortest stillness that counts as a segment, in motion times; a shorter pause belongs to
            the constraint around it.
    """

    floor_position: float = 3e-4
    floor_rotation: float = 1.5e-3
    lever: float = 0.2
    motion_time: float = 0.5
    cells: float = 5.0
    held: float = 1 / 20
    still: float = 1 / 50
    gap: float = 4.0
    reference: float = 1 / 2
    price: float = 7.0
    slack: float = 10.0
    border: float = 1.0
    tail: float = 4.0
    widen: float = 1.5
    same: float = 3.5
    pause: float = 3.0
    still_time: float = 1.5


SEGMENTS = SegmentConstants()
