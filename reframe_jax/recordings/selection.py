"""The options that select data of a file, with the same names in Python and on the command line."""

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

from reframe_jax.recordings.recording import RecordingError

Unit = Literal["m", "cm", "mm"]
TimeUnit = Literal["s", "ms", "us", "ns", "min", "h"]
AngleUnit = Literal["rad", "deg"]
Quaternion = Literal["xyzw", "wxyz"]
Angles = Literal["vector", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]
UNITS: dict[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TIME_UNITS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
ANGLE_UNITS: dict[str, float] = {"rad": 1.0, "deg": math.pi / 180}
QUATERNIONS: tuple[str, ...] = get_args(Quaternion)
ANGLES: tuple[str, ...] = get_args(Angles)

_UNITS = {"unit": UNITS, "time_unit": TIME_UNITS, "angle_unit": ANGLE_UNITS}
_CHOICES: dict[str, Collection[str]] = {**_UNITS, "quaternion": QUATERNIONS, "angles": ANGLES}
_FLAGS = {"from_frame": "--from", "to_frame": "--to", "in_body": "--in"}


@dataclass(frozen=True)
class Selection:
    """Options of :func:`reframe_jax.load_recording`; None for an option that is not given."""

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
        for name, value in self.given.items():
            if name in _CHOICES and value not in _CHOICES[name]:
                raise RecordingError(f"{name} must be one of {', '.join(_CHOICES[name])}, not {value!r}.")
            if name == "episode" and (not isinstance(value, int) or value < 0):
                raise RecordingError(f"episode must be a number from 0, not {value!r}.")
            if name != "episode" and (not isinstance(value, str) or not value):
                raise RecordingError(f"{name} must be a name, not {value!r}.")

    @property
    def given(self) -> dict[str, object]:
        """Names and values of the options that are not None."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def unit_of(path: Path, wanted: Selection, option: str, stated: float | None = None) -> float:
    """Return the unit in m, s or rad that the file states, or else the user; refuse different units."""
    units = _UNITS[option]
    name = getattr(wanted, option)
    given = next(iter(units.values())) if name is None else units[name]
    if stated is None:
        return given
    if name is not None and given != stated:
        raise RecordingError(f"{path}: states another unit than {name}; leave out {flag(option)}.")
    return stated


def flag(name: str) -> str:
    """Name an option in Python and on the command line, for a message: ``in_body (--in)``."""
    return f"{name} ({_FLAGS.get(name, '--' + name.replace('_', '-'))})"
