"""Errors of the robot and its sensors: the differences between a recording and the true motion."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from reframe_jax.compilation import traced


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a demonstration, all zero by default.

    The compliances change the motion, the encoders change the recording only.

    Attributes:
        compliance, angular_compliance: m/N and rad/(N m), of the tool and its mount along constrained axes.
        encoder_noise: rad, standard deviation of every joint reading.
        encoder_step: rad, resolution of joint readings; 0 for no rounding.
    """

    compliance: float | jax.Array = 0.0
    angular_compliance: float | jax.Array = 0.0
    encoder_noise: float | jax.Array = 0.0
    encoder_step: float | jax.Array = 0.0


ENCODER_GRADE = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5)
"""A rigid set-up with 19-bit encoders and one step of noise: 10 to 20 um at the tool."""

REALISTIC = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5, compliance=1e-4, angular_compliance=2.5e-3)
"""The same encoders, and the compliance of a robot that is bolted to a mechanism.

The compliance gives about a third of the RMS velocities along constrained rotations in the paper's Table 4.
"""

MATCHED = Imperfections(encoder_noise=1e-5, encoder_step=1.2e-5, compliance=1e-4, angular_compliance=8e-3)
"""A compliance that reproduces the RMS velocities along constrained axes in the paper's Table 4.

The values apply to motions as fast as in the paper (``excitation="brisk"``): 1-6 mm/s, and 20-60 mrad/s on
the Panda or up to 75 mrad/s on the FR3.
"""


def check_imperfections(given: Any) -> None:
    """Raise a ValueError unless ``given`` is an :class:`Imperfections` with numbers >= 0 or traced values."""
    if not isinstance(given, Imperfections):
        raise ValueError(f"Expected Imperfections(...), not {given!r}.")
    for name, value in vars(given).items():
        if not traced(value) and not np.all(np.asarray(value) >= 0):
            raise ValueError(f"{name} of Imperfections must not be negative or nan; found {value}.")


def by_axis(pair: Any, dtype: Any) -> jax.Array:
    """Expand numbers for (rotations, translations) to six axes, (6,)."""
    return jnp.repeat(jnp.stack([jnp.asarray(number, dtype=dtype) for number in pair]), 3)


def compliance_of(imperfections: Imperfections, dtype: Any) -> jax.Array:
    """Return the compliance (6,), rad/(N m) and m/N, along the angular and linear axes of a constraint."""
    return by_axis((imperfections.angular_compliance, imperfections.compliance), dtype)
