"""All tuned constants of segmentation, with their meaning.

The constants were chosen on the sequences and single constraints of :mod:`benchmarks.segmentation_cases`,
with seeds that the benchmark does not use, and on the recordings of ``../shared/data``.
"""

from typing import NamedTuple


class SegmentConstants(NamedTuple):
    """Constants of segmentation."""

    # m and rad, residuals below this size count as zero: the usual slow errors of a robot or a tracker, of
    # positions at its own origin and of rotations
    floor_position: float = 3e-4
    floor_rotation: float = 1.5e-3
    # rad, RMS rotation with which the origin of the body moves half way to the point that moves least
    turned: float = 0.1
    lever: float = 0.2  # m, distance that converts rotations to translations
    # time of one independent value, as a fraction of the lag at which the speed of displacements has halved;
    # 1 / (2 B) for motion of bandwidth B
    motion_time: float = 0.5
    filled: float = 0.8  # longest gap that is filled, in motion times
    missed: float = 1.5  # smallest mean motion in gaps, over that of the steps beside them
    cells: float = 5.0  # number of cells per motion time
    held: float = 1 / 30  # largest size of a held coordinate, as a fraction of the motion of the recording
    still: float = 1 / 50  # largest size of every coordinate of a still body, as the same fraction
    # amplitude of a free coordinate with little motion, as a fraction of the motion of the recording
    reference: float = 1 / 2
    chance: float = 0.2  # quantile of the sizes of rows by chance, below which rows have evidence
    stop: float = 0.4  # largest speed at a stop, as a fraction of the largest speeds before and after
    # largest ratio of the durations of two movements between stops that replace each other
    stretch: float = 2.5
    # quantile of the path lengths in windows of the recording, below which a motion is slow
    usual: float = 0.4
    # log evidence that a segment costs, beside the logarithm of the number of cells, because the best of many
    # spans and models is chosen; a model that lacks at most its price is kept: the segment may be longer
    price: float = 5.0
    # log evidence, near a border, of a pose that a model explains, and in addition for each row; with one
    # row, residuals above 2.1 times their RMS count as motion
    border: float = 0.7
    tail: float = 4.0  # degrees of freedom of Student's distribution of residuals
    same: float = 3.5  # largest ratio of the sizes of held coordinates in two pieces of one constraint
    still_time: float = 1.5  # shortest stillness that is a segment, in motion times


SEGMENTS = SegmentConstants()
