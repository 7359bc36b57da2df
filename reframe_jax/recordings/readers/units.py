"""Units in the header of a table: ``x [mm]``, ``time (ns)``, ``yaw_deg``."""

import re

from reframe_jax.recordings.selection import ANGLE_UNITS, TIME_UNITS, UNITS


def _spelled(units: dict[str, float], **words: str) -> dict[str, float]:
    """Units, and other words for them."""
    return units | {word: units[unit] for unit, others in words.items() for word in others.split()}


LENGTH_WORDS = _spelled(
    UNITS | {"um": 1e-6},
    um="\u00b5m \u03bcm micrometer micrometers micrometre micrometres",
    m="meter meters metre metres",
    cm="centimeter centimeters centimetre centimetres",
    mm="millimeter millimeters millimetre millimetres",
)
TIME_WORDS = _spelled(
    TIME_UNITS,
    s="sec secs second seconds",
    ms="msec msecs millisecond milliseconds millis",
    us="usec usecs \u00b5s \u03bcs microsecond microseconds micros",
    ns="nsec nsecs nanosec nanosecs nanosecond nanoseconds nanos",
    min="mins minute minutes",
    h="hr hrs hour hours",
)
ANGLE_WORDS = _spelled(ANGLE_UNITS, deg="degree degrees \u00b0", rad="radian radians")
_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*", re.DOTALL)
_WORDS = {**LENGTH_WORDS, **TIME_WORDS, **ANGLE_WORDS}


def units_of_row(cells: list[str]) -> list[str] | None:
    """Return the units in a row of units below a header; None for another row."""
    units = [cell.strip("[]() -").lower() for cell in cells]
    return units if any(units) and all(unit in _WORDS or not unit for unit in units) else None


def plain_name(title: str) -> str:
    """Convert a title to lower case, with underscores between words: ``HMDPosX`` to ``hmd_pos_x``."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", title)
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


def split_unit(title: str) -> tuple[str, str]:
    """Return the plain name and the unit of a column; the unit is empty if the title states none."""
    match = _IN_BRACKETS.fullmatch(title)
    name, unit = (match[1], match[2].lower()) if match else (title, "")
    plain = plain_name(name)
    first, _, last = plain.rpartition("_")
    return (first, last) if not unit and first and last in _WORDS else (plain, unit)
