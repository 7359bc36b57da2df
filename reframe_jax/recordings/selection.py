"""What a user chooses to read from a file: the same words in Python and on the command line."""

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args

from reframe_jax.recordings.recording import RecordingError

__all__ = [
    "ANGLES",
    "ANGLE_UNITS",
    "QUATERNIONS",
    "TIME_UNITS",
    "UNITS",
    "AngleUnit",
    "Angles",
    "Quaternion",
    "Selection",
    "TimeUnit",
    "Unit",
    "flag",
]

Unit = Literal["m", "cm", "mm"]
TimeUnit = Literal["s", "ms", "us", "ns"]
AngleUnit = Literal["rad", "deg"]
Quaternion = Literal["xyzw", "wxyz"]
Angles = Literal["vector", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]
UNITS: dict[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TIME_UNITS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
ANGLE_UNITS: dict[str, float] = {"rad": 1.0, "deg": math.pi / 180}
QUATERNIONS: tuple[str, ...] = get_args(Quaternion)
ANGLES: tuple[str, ...] = get_args(Angles)

_CHOICES = {
    "unit": tuple(UNITS),
    "time_unit": tuple(TIME_UNITS),
    "quaternion": QUATERNIONS,
    "angles": ANGLES,
    "angle_unit": tuple(ANGLE_UNITS),
}
_FLAGS = {"from_frame": "--from", "to_frame": "--to", "in_body": "--in"}


@dataclass(frozen=True)
class Selection:
    """Options of :func:`reframe_jax.load_recording`, which describes them; None where nothing is given."""

    unit: Unit | None = None
    time_unit: TimeUnit | None = None
    topic: str | None = None
    from_frame: str | None = None
    to_frame: str | None = None
    body: str | None = None
    in_body: str | None = None
    position: str | None = None
    orientation: str | None = None
    quaternion: Quaternion | None = None
    angles: Angles | None = None
    angle_unit: AngleUnit | None = None
    episode: int | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value is not None and value not in choices:
                raise RecordingError(f"{name} must be one of {', '.join(choices)}, not {value!r}.")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "episode":
                if value is not None and (not isinstance(value, int) or value < 0):
                    raise RecordingError(f"episode must be a number from 0, not {value!r}.")
            elif value is not None and (not isinstance(value, str) or not value):
                raise RecordingError(f"{field.name} must be a name, not {value!r}.")

    @property
    def given(self) -> list[str]:
        """Names of the options that are set."""
        return [field.name for field in fields(self) if getattr(self, field.name) is not None]


def flag(name: str) -> str:
    """An option as messages call it, in Python and on the command line: ``in_body (--in)``."""
    return f"{name} ({_FLAGS.get(name, '--' + name.replace('_', '-'))})"
