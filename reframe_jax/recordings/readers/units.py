"""Units that the header of a table states: ``x [mm]``, ``time (ns)``, ``yaw_deg``."""

import re

from reframe_jax.recordings.selection import ANGLE_UNITS, TIME_UNITS, UNITS

__all__ = ["ANGLE_WORDS", "LENGTH_WORDS", "TIME_WORDS", "split_unit", "units_of_row"]

LENGTH_WORDS = UNITS | {
    **dict.fromkeys(("meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
}
TIME_WORDS = TIME_UNITS | {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("msec", "msecs", "millisecond", "milliseconds", "millis"), 1e-3),
    **dict.fromkeys(("usec", "usecs", "\u00b5s", "\u03bcs", "microsecond", "microseconds", "micros"), 1e-6),
    **dict.fromkeys(("nsec", "nsecs", "nanosec", "nanosecs", "nanosecond", "nanoseconds", "nanos"), 1e-9),
}
ANGLE_WORDS = ANGLE_UNITS | {
    **dict.fromkeys(("degree", "degrees", "\u00b0"), ANGLE_UNITS["deg"]),
    **dict.fromkeys(("radian", "radians"), 1.0),
}
_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*", re.DOTALL)
_WORDS = {**LENGTH_WORDS, **TIME_WORDS, **ANGLE_WORDS}


def units_of_row(cells: list[str]) -> list[str] | None:
    """The units in a row of units, as some programs write it after the header; None for another row."""
    units = [cell.strip("[]() -").lower() for cell in cells]
    return units if any(units) and all(unit in _WORDS or not unit for unit in units) else None


def split_unit(title: str) -> tuple[str, str]:
    """The name of a column in plain letters, and its unit; empty if the title states none.

    The name is in lower case, with single underscores for all other characters.
    """
    match = _IN_BRACKETS.fullmatch(title)
    name, unit = (match[1], match[2].lower()) if match else (title, "")
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    first, _, last = plain.rpartition("_")
    if not unit and first and last in _WORDS:
        return first, last
    return plain, unit
