"""All tuned constants, with their meaning. Each was chosen on recordings, with seeds that no test uses.

- ``MOTION``: real recordings by cameras, and simulated ones with outliers, gaps and stops;
- ``EVIDENCE``: about 3,000 simulated recordings (white noise of 1 um to 3 mm; slow errors of 0.1 to 3 mm and
  0.5 to 10 mrad; exciting, slow and single-sine motion), and 52 real ones;
- ``SEGMENTS``: the sequences and single constraints of :mod:`benchmarks.segmentation_cases`.
"""

from math import log
from typing import NamedTuple


class Motion(NamedTuple):
    """Constants of :mod:`reframe_jax.motion`: outliers and gaps."""

    noises: float = 4.0  # smallest distance from the cubic, in medians of its noise: six standard deviations
    agree: float = 3.0  # the same, in distances of the two other poses from the cubic
    sudden: float = 0.4  # smallest distance of the ends of a run from the cubic, over that of its middle
    # fourth difference across either end of a run over the distance; at least 0.24 for a jump
    jump: float = 0.12
    gap: float = 2.0  # motion in gaps over that in other steps; less, if poses arrive in bursts


class Evidence(NamedTuple):
    """Constants of :mod:`reframe_jax.model`: scales, evidence and its densities.

    Attributes:
        above_noise: a scale is used if block differences of positions or rotations exceed so many noises.
        late: octaves between the smallest scales of both groups beyond which one of them only drifts.
        error_position, error_rotation: m and rad, median slow errors of a tracker or a robot without noise.
        error_of_noise: slow error per unit of white noise; its square is added to that of the median.
        error_spread: standard deviation of the log of slow errors (a factor 5); results depend most on it.
        error_correlation: correlation of the logs of slow errors of positions and of rotations.
        turn, lever: median free rotation, rad, and median ratio of free translation to free rotation, m/rad.
        motion_spread: standard deviation of the logs of both.
        unusual, unusual_spread: fraction of motions that are much smaller or larger, and their standard
            deviations relative to this one; without them, a free motion of 0.05 rad counts as an error.
        free_above: slope by which the log density of free amplitudes falls above the size of the motion.
        scale_error: largest scale error of a tracker, as a fraction of the translation that the only free
            rotation causes.
        worth: largest number of independent values in the comparison of variances between entries.
        repeatable_part: amplitude, as a fraction of the smallest slow error, that is added in this comparison
            to every coordinate of entries with more freedom.
        repeatable_gain: largest factor by which this raises one; fits seldom reduce such errors by more.
        nothing_held: cost of an unconstrained motion, in log evidence; with 0, fewer soft contacts are named.
        nothing_power: exponent of the mean over the linear types that describe an unconstrained motion;
            with 1, fewer soft contacts are named; with the minimum, less long free motion.
        screw_worth: largest number of independent values in the comparison of the translation of a screw
            with its rotation.
        pitch_cost: cost of a pitch: its log is uniform over three decades for each sign, and a screw is less
            common than a hinge by a factor 7.
    """

    above_noise: float = 6.0
    late: int = 2
    error_position: float = 2e-4
    error_rotation: float = 1e-4
    error_of_noise: float = 0.3
    error_spread: float = log(5.0)
    error_correlation: float = 0.8
    turn: float = 1.5
    lever: float = 0.2
    motion_spread: float = 0.35
    unusual: float = 0.01
    unusual_spread: float = 6.0
    free_above: float = 3.0
    scale_error: float = 0.12
    worth: float = 2.5
    repeatable_part: float = 0.5
    repeatable_gain: float = 3.0
    nothing_held: float = 2.0
    nothing_power: float = 1 / 3
    screw_worth: float = 6.0
    pitch_cost: float = log(13.8 * 7)


class Segments(NamedTuple):
    """Constants of :mod:`reframe_jax.segmentation`."""

    # m and rad, residuals below this size count as zero: the usual slow errors of a robot or a tracker, of
    # positions at its own origin and of rotations
    floor_position: float = 3e-4
    floor_rotation: float = 1.5e-3
    # rad, RMS rotation with which the origin of the body moves half way to the point that moves least
    turned: float = 0.1
    filled: float = 0.8  # longest gap that is filled, in motion times
    cells: float = 5.0  # number of cells per motion time
    held: float = 1 / 30  # largest size of a held coordinate, as a fraction of the motion of the recording
    still: float = 1 / 50  # largest size of every coordinate of a still body, as the same fraction
    # amplitude of a free coordinate with little motion, as a fraction of the motion of the recording
    reference: float = 1 / 2
    chance: float = 0.2  # quantile of the sizes of rows by chance, below which rows have evidence
    stop: float = 0.4  # largest speed at a stop, as a fraction of the largest speeds before and after
    # log evidence that a segment costs, beside the logarithm of the number of cells, because the best of many
    # spans and models is chosen; a model that lacks at most its price is kept: the segment may be longer
    price: float = 5.0
    # log evidence, near a border, of a pose that a model explains, and in addition for each row; with one
    # row, residuals above 2.1 times their RMS count as motion
    border: float = 0.7
    tail: float = 4.0  # degrees of freedom of Student's distribution of residuals
    # largest ratio of durations of movements that replace each other, and of held sizes in one constraint
    alike: float = 3.0


MOTION, EVIDENCE, SEGMENTS = Motion(), Evidence(), Segments()
