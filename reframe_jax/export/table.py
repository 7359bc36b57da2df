"""Write an identification as a table, for people."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from reframe_jax.constraints.types import BODY_NAMES, LinearType
from reframe_jax.export import common
from reframe_jax.identification.results import Identification
from reframe_jax.joints.joint import format_vector, two_digits
from reframe_jax.motion.checks import Status
from reframe_jax.recordings.recording import Recording, name_rows

_UNITS = {"angular": "rad/s", "linear": "m/s"}
_SIZES = {"angular": "mrad", "linear": "mm"}
_CLEAR = 0.99  # probabilities above this value are not printed
_LISTED = 6  # largest number of outliers listed in a line


def to_table(
    found: Identification, *, label: str | None = None, windows: Sequence[common.Window] | None = None
) -> str:
    """Format an identification as text: a paragraph for one window, one row per window for a batch.

    The number in parentheses after a name is its probability (see :attr:`Identification.probability`). The
    number after "free" or "constrained" is the probability of this degree of freedom, printed if it is below
    0.99.

    Args:
        found: the identification of one window, or of a batch.
        label: heading, such as the name of the recording.
        windows: the part of the recording that each window covers, as
            :class:`reframe_jax.export.common.Window`; a list of one for a single window.

    Raises:
        ValueError: if the number of ``windows`` differs from the number in ``found``.
    """
    host = jax.device_get(found)
    if np.ndim(host.status_code):
        return "\n".join(_batch_table(common.split_windows(host), label, windows))
    heading = f"{label}: {host.name}" if label else host.name
    if host.status.failed:
        return heading
    (window,) = windows or (None,)
    probability = common.format_probability(host.probability)
    heading += "" if probability == "-" else f" ({probability})"
    blocks = [heading, *dict.fromkeys([host.status.message, *host.warnings]), ""]
    crossed = np.isfinite(host.universal_axes).all()
    for group in common.TYPES:  # no angular frame expresses two axes in different bodies
        blocks += [] if crossed and group == "angular" else _frame_block(group, getattr(host, group))
    if np.isfinite(host.pitch):
        hand = "right" if host.pitch > 0 else "left"
        lead = f"{2e3 * np.pi * abs(host.pitch):.4g} mm per turn, {hand}-handed"
        blocks += [f"Pitch   {host.pitch:.4g} m/rad: {lead}", ""]
    if crossed:
        ground, body = (format_vector(axis, 3) for axis in host.universal_axes)
        blocks += [f"Turns   about {ground} in the ground and {body} in the body", ""]
    return "\n".join([*blocks, *_norms_block(host), _noise_line(host, window)])


def rows_to_table(recording: Recording, found: Identification) -> str:
    """List the rows of a file that were left out, one line per reason; empty if all rows were used."""
    used, unused = common.count_rows(recording, common.split_windows(jax.device_get(found)))
    if not unused:
        return ""
    lines = [f"Rows    {used} of {used + sum(len(each.rows) for each in unused)} used; left out:"]
    lines += [f"  {name_rows(recording.row_word, each.rows)}: {each.why}" for each in unused]
    return "\n".join(lines)


def _frame_block(group: str, frame: Any) -> list[str]:
    kind = frame.frame_type
    others = [name for name in common.tied_names(group, frame) if name != str(kind)]
    ties = f"; tied with {', '.join(others)}" if others else ""
    ties = " and ".join(ties.rsplit(", ", 1))
    if isinstance(kind, LinearType):
        axes_in, origin_in = BODY_NAMES[kind.orientation_body], BODY_NAMES[kind.position_body]
        where = "axes and origin" if axes_in == origin_in else f"axes in the {axes_in}, origin"
        lines = [f"Linear frame {kind}: {where} fixed in the {origin_in}{ties}"]
    else:
        lines = [f"Angular frame {kind}: axes fixed in the {BODY_NAMES[kind]}{ties}"]
    for i, axis in enumerate(np.asarray(frame.axes).T):
        freedom = "free" if frame.dof[i] else "constrained"
        likely = frame.free_probability[i] if frame.dof[i] else 1 - frame.free_probability[i]
        if likely < _CLEAR:
            freedom += f" ({common.format_probability(likely)})"
        size = f"RMS {two_digits(1e3 * frame.amplitude[i])} {_SIZES[group]}"
        speed = f"{frame.rms[i]:>8.3g} {_UNITS[group]:5}"
        lines.append(f"  axis {i + 1}  {format_vector(axis, 3, 6)}  {speed}  {freedom}, {size}")
    if isinstance(kind, LinearType):
        lines.append(f"  origin  {format_vector(frame.position, 4)} m in the {origin_in}")
        along = [format_vector(direction, 3) for direction in common.directions(frame.free_position)]
        if len(along) == 3:
            lines.append("          any position is valid; the one closest to the motion is given")
        elif along:
            lines.append(f"          not determined along {' and '.join(along)}")
    turns = [i for i in range(3) if frame.free_rotation[i]]
    if len(turns) == 3:
        lines.append("          all directions are equal, so these axes are arbitrary")
    elif turns:
        first, second = (i + 1 for i in range(3) if i not in turns)
        lines.append(f"          axes {first} and {second} are arbitrary within their plane")
    return [*lines, ""]


def _noise_line(found: Identification, window: common.Window | None) -> str:
    """Format the noise of the poses, the smallest time scale, and the poses that were left out."""
    scale, out = int(found.scale), common.outlier_samples(found, window)
    position, rotation = 1e3 * found.noise.position, np.degrees(found.noise.rotation)
    over = f"blocks of {scale} sample{'' if scale == 1 else 's'}"
    if window is not None:
        period = (window.stop_time - window.start_time) / (window.stop - window.start - 1)
        over += f" ({scale * period:.2g} s)"
    parts = [f"{position:.2g} mm, {rotation:.2g} deg", over]
    if out:
        listed = ", ".join(map(str, out[:_LISTED]))
        more = f" and {len(out) - _LISTED} more" if len(out) > _LISTED else ""
        plural = "" if len(out) == 1 else "s"
        parts.append(f"{len(out)} pose{plural} left out: sample{plural} {listed}{more}")
    return "Noise   " + "; ".join(parts)


def _norms_block(found: Identification) -> list[str]:
    lines, tied = [], False
    for group, types in common.TYPES.items():
        frame = getattr(found, group)
        entries = []
        for kind in types:
            mark = "*" if kind == int(frame.type_code) else "~" if frame.tied[kind] else " "
            tied |= mark == "~"
            entries.append(f"{kind} {frame.norms[kind]:.3g}{mark}")
        lines.append(f"Norms   {group:7}  {'  '.join(entries).rstrip()}  {_UNITS[group]}")
    lines.append("        * reported" + (", ~ tied: fits equally well" if tied else ""))
    return lines


def _batch_table(
    each: list[Identification], label: str | None, windows: Sequence[common.Window] | None
) -> list[str]:
    columns = ["window", "name", "prob.", "angular", "linear", "origin [m]", "status"]
    rows = [_batch_row(index, found) for index, found in enumerate(each)]
    if windows is not None:
        columns.insert(1, "time [s]")
        for row, window in zip(rows, windows, strict=True):
            row.insert(1, f"{window.start_time:.2f} - {window.stop_time:.2f}")
    count = f"{len(each)} window{'' if len(each) == 1 else 's'}"
    statuses = sorted({found.status for found in each} - {Status.OK})
    ties = any("~" in cell for row in rows for cell in row)
    notes = [note for found in each if not found.status.failed for note in found.warnings]
    notes = [note for note in notes if note != Status.ON_BOUNDS.message]
    return [
        f"{label}: {count}" if label else count,
        *common.align_columns([columns, *rows]),
        *(["~ tied: fits equally well"] if ties else []),
        *(f"{status.name}: {status.message}" for status in statuses),
        *dict.fromkeys(notes),
    ]


def _batch_row(index: int, found: Identification) -> list[str]:
    status = found.status.name
    if found.status.failed:
        return [str(index), "-", "-", "-", "-", "-", status]
    kinds = []
    for group in common.TYPES:
        frame = getattr(found, group)
        kind = str(frame.frame_type)
        kinds.append("~".join([kind, *(name for name in common.tied_names(group, frame) if name != kind)]))
    origin = format_vector(found.linear.position, 3, 6)
    return [str(index), found.name, common.format_probability(found.probability), *kinds, origin, status]
