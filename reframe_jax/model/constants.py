"""Every tuned constant of the model, with where it comes from.

The figures behind them: about 3,000 simulated recordings (white noise of 1 um to 3 mm; slow errors of 0.1 to
3 mm and 0.5 to 10 mrad; exciting, slow and single-sine motion) and 52 real ones, on seeds that are not used
in tests.
"""

from math import log
from typing import NamedTuple

__all__ = ["EVIDENCE", "SCALES", "Evidence", "Scales"]


class Evidence(NamedTuple):
    """Constants of :mod:`.evidence`.

    Attributes:
        error_position, error_rotation: m and rad, usual slow errors of a tracker or a robot, and
            error_of_noise: their usual share of the white noise, added in squares.
        error_spread: of the logarithm of slow errors: a factor 5, the one that matters most.
        tilt_above: power of the variance ratio by which tilts above the size of errors are improbable.
        turn, turn_spread: rad, usual free rotation, and the spread of its logarithm.
        lever, lever_spread: m/rad, usual free translation over free rotation, and its spread.
        free_above: steepness of the density of free amplitudes above the size of the motion.
        scale_error: share of a rotation that a tracker may be wrong by, in scale.
        amplitude_variance: of a log mean square beyond its sampling error.
        worth: independent values of a motion that a likelihood of held coordinates counts at most.
        per_parameter: log evidence that a parameter costs.
        screw_worth: independent values that the agreement of slide and turn counts at most.
        pitch_range: log of the range of pitches: three decades, two signs.
    """

    error_position: float = 2e-4
    error_rotation: float = 1e-4
    error_of_noise: float = 0.3
    error_spread: float = log(5.0)
    tilt_above: int = 3
    turn: float = 1.5
    turn_spread: float = 0.25
    lever: float = 0.2
    lever_spread: float = 0.5
    free_above: float = 3.0
    scale_error: float = 0.12
    amplitude_variance: float = 0.03
    worth: float = 2.5
    per_parameter: float = 1.0
    screw_worth: float = 6.0
    pitch_range: float = log(13.8)


class Scales(NamedTuple):
    """Constants of the choice of scales.

    Attributes:
        above_noise: noises that block differences of position and rotation exceed at the smallest scale.
    """

    above_noise: float = 6.0


EVIDENCE = Evidence()
SCALES = Scales()
