"""The registry of readers: suffix and content select one.

To add a format, copy ``trajectory.py`` and add its :class:`Reader` here. Of the readers with the suffix of a
file, the first one that recognises its first bytes reads it. Optional libraries are imported when a file
needs them.
"""

from pathlib import Path

from reframe_jax.recordings.readers.arrays import ARRAYS
from reframe_jax.recordings.readers.bags import BAG
from reframe_jax.recordings.readers.c3d import C3D
from reframe_jax.recordings.readers.echo import ECHO
from reframe_jax.recordings.readers.hdf5 import HDF5
from reframe_jax.recordings.readers.kitti import KITTI
from reframe_jax.recordings.readers.lines import head_in_utf8
from reframe_jax.recordings.readers.mha import MHA
from reframe_jax.recordings.readers.motive import MOTIVE
from reframe_jax.recordings.readers.ndi import NDI
from reframe_jax.recordings.readers.parquet import PARQUET
from reframe_jax.recordings.readers.qualisys import QUALISYS
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.readers.table import TABLE
from reframe_jax.recordings.readers.trajectory import TRAJECTORY
from reframe_jax.recordings.readers.trc import TRC
from reframe_jax.recordings.readers.vicon import VICON
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.selection import Selection, flag

__all__ = ["READERS", "check_options", "choose_reader"]

READERS: tuple[Reader, ...] = (
    *(MOTIVE, VICON, QUALISYS, NDI, ECHO, KITTI, TRAJECTORY, TABLE),
    *(ARRAYS, BAG, C3D, TRC, MHA, PARQUET, HDF5),
)

_HEAD = 4096  # bytes by which a format is recognised
_FOLDER = "/"


def choose_reader(path: Path) -> Reader:
    """The reader of a file or folder.

    Raises:
        RecordingError: if there is none for its suffix, or its content is not of these formats.
        OSError: from the file.
    """
    folder = path.is_dir()
    suffix = _FOLDER if folder else path.suffix.lower()
    if suffix in (".pkl", ".pickle"):
        raise RecordingError(f"{path}: pickles can run code when they are read; save arrays as .npz instead.")
    candidates = [reader for reader in READERS if suffix in reader.suffixes]
    if not candidates and not folder:
        suffixes = dict.fromkeys(each for reader in READERS for each in reader.suffixes if each != _FOLDER)
        raise RecordingError(f"{path}: expected one of {', '.join(suffixes)}, not the suffix {suffix!r}.")
    head = b""
    if not folder or not any(reader.recognises(path, head) for reader in candidates):
        with path.open("rb") as file:  # of a folder that is no recording, an OSError says so
            head = head_in_utf8(file.read(_HEAD))
    for reader in candidates:
        if reader.recognises(path, head):
            return reader
    names = " or ".join(reader.name for reader in candidates)
    raise RecordingError(f"{path}: expected {names}; the content is of another kind.")


def check_options(path: Path, reader: Reader, wanted: Selection) -> None:
    """Refuse options that the format does not use.

    Raises:
        RecordingError: that names the option and those that may be used instead.
    """
    for name in wanted.given:
        if name not in reader.options:
            used = ", ".join(flag(each) for each in sorted(reader.options)) or "none of them"
            raise RecordingError(
                f"{path}: is {reader.name}, which does not use {flag(name)}; options for it: {used}."
            )
