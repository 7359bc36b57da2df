"""The tuned constants of the model, with where they come from.

The figures behind them: about 3,000 simulated recordings (white noise of 1 um to 3 mm; slow errors of 0.1 to
3 mm and 0.5 to 10 mrad; exciting, slow and single-sine motion) and 52 real ones, on seeds that are not used
in tests.
"""

from math import log
from typing import NamedTuple


class Evidence(NamedTuple):
    """Constants of :mod:`.evidence`.

    Attributes:
        error_position, error_rotation: m and rad, median slow errors of a tracker or a robot without noise.
        error_of_noise: slow error per unit of white noise; its square is added to that of the median.
        error_spread: standard deviation of the log of slow errors (a factor 5); results depend most on it.
        error_correlation: correlation of the logs of slow errors of positions and of rotations.
        error_centre: m, largest distance between the origin of the body and the centre of rotation errors.
        tilt_above: exponent n of the density (e^2 / (e^2 + tilt^2))^n of a tilt; e: slow rotation error.
        turn, turn_spread: median free rotation, rad, and the standard deviation of its log.
        lever, lever_spread: median ratio of free translation to free rotation, m/rad, and the standard
            deviation of its log.
        unusual, unusual_spread: fraction of motions that are much smaller or larger, and their standard
            deviations relative to those above; without them, a free motion of 0.05 rad counts as an error.
        free_above: slope by which the log density of free amplitudes falls above the size of the motion.
        scale_error: largest scale error of a tracker, as a fraction of the translation that the only free
            rotation causes.
        amplitude_variance: variance of the log of a mean square, in addition to its sampling variance.
        worth: largest number of independent values in the comparison of variances between entries.
        repeatable_part: amplitude, as a fraction of the smallest slow error, that is added in this comparison
            to every coordinate of entries with more freedom.
        repeatable_gain: largest factor by which this raises one; fits seldom reduce such errors by more.
        per_parameter: cost of a parameter, in log evidence.
        nothing_held: cost of an unconstrained motion, in log evidence; with 0, fewer soft contacts are named.
        nothing_power: exponent of the mean over the linear types that describe an unconstrained motion;
            with 1, fewer soft contacts are named; with the minimum, less long free motion.
        screw_worth: largest number of independent values in the comparison of the translation of a screw
            with its rotation.
        pitch_cost: cost of a pitch: its log is uniform over three decades for each sign, and a screw is less
            common than a hinge by a factor 7.
    """

    error_position: float = 2e-4
    error_rotation: float = 1e-4
    error_of_noise: float = 0.3
    error_spread: float = log(5.0)
    error_correlation: float = 0.8
    error_centre: float = 1.0
    tilt_above: int = 3
    turn: float = 1.5
    turn_spread: float = 0.25
    lever: float = 0.2
    lever_spread: float = 0.5
    unusual: float = 0.01
    unusual_spread: float = 6.0
    free_above: float = 3.0
    scale_error: float = 0.12
    amplitude_variance: float = 0.03
    worth: float = 2.5
    repeatable_part: float = 0.5
    repeatable_gain: float = 3.0
    per_parameter: float = 1.0
    nothing_held: float = 1.5
    nothing_power: float = 1 / 3
    screw_worth: float = 6.0
    pitch_cost: float = log(13.8 * 7)


EVIDENCE = Evidence()
ABOVE_NOISE = 6.0  # a scale is used if block differences of positions or rotations exceed so many noises
