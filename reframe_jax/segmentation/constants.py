"""All tuned constants of segmentation, with their meaning.

The constants were chosen on the sequences and single constraints of :mod:`benchmarks.segmentation_cases`,
with seeds that the benchmark does not use, and on the recordings of ``../shared/data``.
"""

from typing import NamedTuple


class SegmentConstants(NamedTuple):
    """Constants of segmentation.

    Attributes:
        floor_position, floor_rotation: m and rad, residuals below this size count as zero: the usual slow
            errors of a robot or a tracker.
        lever: distance that converts rotations to translations, m.
        motion_time: time of one independent value, as a fraction of the lag at which the speed of
            displacements has halved; 1 / (2 B) for motion of bandwidth B.
        cells: number of cells per motion time.
        held: largest size of a held coordinate, as a fraction of the motion of the recording.
        still: largest size of every coordinate of a still body, as the same fraction.
        gap: smallest ratio of the largest motion of a span to a coordinate held in this span.
        reference: amplitude of a free coordinate with little motion, as a fraction of the motion of the
            recording.
        chance: quantile of the sizes of rows by chance, below which rows have evidence.
        stop: largest speed at a stop, as a fraction of the largest speeds before and after.
        stretch: largest ratio of the durations of two movements between stops that replace each other.
        usual: quantile of the path lengths in windows of the recording, below which a motion is slow.
        price: log evidence that a segment costs, because the best of many spans and models is chosen. A
            model that lacks at most this evidence is kept, because the segment may be longer.
        border: log evidence, near a border, of a pose that a model explains, and in addition for each row.
            With one row, residuals above 2.6 times their RMS count as motion.
        tail: degrees of freedom of Student's distribution of residuals.
        widen: factor on residuals of models fitted to windows: fits to few values have too small residuals.
        same: largest ratio of the sizes of held coordinates in two pieces of one constraint.
        pause: smallest ratio of the motion beside a pause to the motion in the pause.
        still_time: shortest stillness that is a segment, in motion times.
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
    stop: float = 0.4
    stretch: float = 2.5
    usual: float = 0.4
    price: float = 9.0
    border: float = 1.0
    tail: float = 4.0
    widen: float = 1.5
    same: float = 3.5
    pause: float = 3.0
    still_time: float = 1.5


SEGMENTS = SegmentConstants()
