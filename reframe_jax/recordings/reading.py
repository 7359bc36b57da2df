"""Read recordings from files, with NumPy only.

``Recording.notes`` lists rows that were left out, repairs and doubts. Every other problem raises a
:class:`RecordingError` with the place, the expected content and the remedy.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from reframe_jax.recordings import checks, clock
from reframe_jax.recordings.conventions import check_order, set_order
from reframe_jax.recordings.readers import choose_reader
from reframe_jax.recordings.readers.reader import Entry, Reader
from reframe_jax.recordings.recording import Recording, RecordingError, Rows
from reframe_jax.recordings.relative import relative_poses
from reframe_jax.recordings.selection import Angles, AngleUnit, Quaternion, Selection, TimeUnit, Unit, unit_of

TIMES_IGNORED = "the times in the file are ignored"


def load_recording(
    path: str | Path,
    *,
    unit: Unit | None = None,
    time_unit: TimeUnit | None = None,
    dt: float | None = None,
    topic: str | None = None,
    from_frame: str | None = None,
    to_frame: str | None = None,
    body: str | None = None,
    in_body: str | None = None,
    position: str | None = None,
    orientation: str | None = None,
    quaternion: Quaternion | None = None,
    angles: Angles | None = None,
    angle_unit: AngleUnit | None = None,
    episode: int | None = None,
) -> Recording:
    """Read a recording of poses.

    The suffix and the first bytes of a file select its format: tables with named columns (``.csv``,
    ``.tsv``, ``.txt``, ``.tum``), trajectories of TUM and KITTI, arrays of NumPy (``.npy``, ``.npz``),
    exports of motion capture (``.csv``, ``.tsv``, ``.trc``, ``.c3d``, ``.mha``), ROS bags (``.bag``,
    ``.mcap``, ``.db3``, or a folder) and data sets (``.parquet``, ``.hdf5``). The page Files of the
    documentation lists the options of each format, and the names of columns and arrays. An option that a
    format does not use is an error.

    A recording has at most 8,388,608 poses. Reading a million poses needs about 450 MB, and twice as much for
    a chain of tf frames.

    Args:
        path: the file or folder.
        unit: unit of positions, for files that do not state it; m by default.
        time_unit: unit of times, for files that do not state it; s by default.
        dt: sample time in s, for files without times; times in the file are ignored.
        topic: topic of a bag.
        from_frame: tf frame of a bag that serves as the ground.
        to_frame: tf frame of a bag whose pose is read.
        body: rigid body; for markers, a prefix of their names, or names with commas between them.
        in_body: body in whose frame the poses are expressed, see :func:`relative_poses`; in a bag, its topic.
        position: columns of the positions, with 3 numbers.
        orientation: columns of the orientations, with 4 numbers (quaternion), 3 (angles) or 9 (matrix).
        quaternion: order of the numbers of a quaternion in the file, independent of their names.
        angles: convention of three angles: "vector" for a rotation vector, "XYZ" and so on for rotations
            about the moving axes (x first), "xyz" and so on for rotations about the fixed axes.
        angle_unit: unit of these angles, for files that do not state it; rad by default.
        episode: number of the episode in a file with several.

    Returns:
        The recording, in m and s, without the rows in which tracking was lost.

    Raises:
        RecordingError: if the file or one of its rows cannot be used, if an option is wrong, or if a needed
            library is not installed.
    """
    path = Path(path)
    wanted = Selection(
        *(unit, time_unit, topic, from_frame, to_frame, body, in_body),
        *(position, orientation, quaternion, angles, angle_unit, episode),
    )
    if dt is not None and not 0 < dt < np.inf:
        raise RecordingError(f"dt must be a positive number of seconds, not {dt!r}.")
    with _in_one_line(path):
        reader = choose_reader(path, wanted)
        absolute = replace(wanted, in_body=None)
        recording = _load(path, reader, absolute, dt)
        if in_body is None:
            return recording
        by_topic = "topic" in reader.options
        other = replace(absolute, topic=in_body) if by_topic else replace(absolute, body=in_body)
        return relative_poses(recording, _load(path, reader, other, dt))


def list_contents(path: str | Path) -> tuple[str, list[Entry] | None]:
    """List the data in a file or folder: topics, frames, bodies, markers or columns.

    The result is the name of the format, and the data; None for formats with a single recording. A
    RecordingError is raised if the file cannot be read.
    """
    path = Path(path)
    with _in_one_line(path):
        reader = choose_reader(path, Selection())
        return reader.name, reader.contents(path) if reader.contents else None


@contextmanager
def _in_one_line(path: Path) -> Iterator[None]:
    """Replace errors of the disk and of the encoding by a :class:`RecordingError`."""
    try:
        yield
    except RecordingError:
        raise
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is not a text file; expected UTF-8.") from error
    except (OSError, ValueError) as error:  # ValueError: the path contains a zero byte
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: cannot be read: {reason}.") from error


def _load(path: Path, reader: Reader, wanted: Selection, dt: float | None) -> Recording:
    with np.errstate(all="ignore"):  # the checks refuse numbers whose squares are infinite
        rows = reader.read(path, wanted)
        if "time_unit" not in reader.options:
            rows.seconds = 1.0
        set_order(rows, wanted)
        ignored = dt is not None and rows.times is not None
        clock.make_times(rows, dt, wanted)
        checks.drop_unfinished(rows)
        clock.sort_times(rows)
        clock.drop_equal_times(rows)
        _check_count(rows)
        poses = checks.make_poses(rows)
        poses[:, :3, 3] *= unit_of(path, wanted, "unit", rows.metres)
        poses = checks.leave_out_lost(rows, poses)
        poses, unordered = checks.check_positions(rows, poses, wanted)
        _check_count(rows)
        checks.check_turns(rows, poses, wanted, unordered)
        clock.note_unit(rows, poses, unordered)
        check_order(rows, reader.options, poses, unordered, wanted)
        if not unordered:
            checks.note_jumps(rows, poses)
        checks.note_repeats(rows, poses)
    if ignored:
        rows.notes.append(f"{TIMES_IGNORED}; the sample time is {dt:g} s.")
    return Recording(
        *(np.asarray(rows.times), poses, path, tuple(rows.notes), rows.origin),
        *(rows.wrenches, rows.where, rows.word, tuple(rows.left_out)),
    )


def _check_count(rows: Rows) -> None:
    if len(rows.values) < checks.MIN_POSES:
        problem = f"has {len(rows.values)} usable poses; expected {checks.MIN_POSES} or more."
        raise RecordingError(f"{rows.path}: " + " ".join([problem, *rows.notes[-3:]]))
