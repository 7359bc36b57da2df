"""All readers. The suffix and the first bytes of a file select a reader.

To add a format, copy ``trajectory.py`` and add its :class:`Reader` to ``READERS``. The first reader with the
suffix of a file that recognises its first bytes reads the file. Readers import optional libraries on use.
"""

import stat
from pathlib import Path

from reframe_jax.recordings.readers.arrays import ARRAYS
from reframe_jax.recordings.readers.bags import BAG
from reframe_jax.recordings.readers.c3d import C3D
from reframe_jax.recordings.readers.datasets import HDF5, PARQUET
from reframe_jax.recordings.readers.lines import head_in_utf8
from reframe_jax.recordings.readers.mha import MHA
from reframe_jax.recordings.readers.motive import MOTIVE
from reframe_jax.recordings.readers.ndi import NDI
from reframe_jax.recordings.readers.qualisys import QUALISYS
from reframe_jax.recordings.readers.reader import Reader
from reframe_jax.recordings.readers.table import TABLE
from reframe_jax.recordings.readers.trajectory import ECHO, KITTI, TRAJECTORY
from reframe_jax.recordings.readers.trc import TRC
from reframe_jax.recordings.readers.vicon import VICON
from reframe_jax.recordings.recording import RecordingError
from reframe_jax.recordings.selection import Selection, flag

READERS: tuple[Reader, ...] = (
    *(MOTIVE, VICON, QUALISYS, NDI, ECHO, KITTI, TRAJECTORY, TABLE),
    *(ARRAYS, BAG, C3D, TRC, MHA, PARQUET, HDF5),
)

_HEAD = 4096  # first bytes, by which a reader recognises its format
_FOLDER = "/"
_REMEDIES = {
    **dict.fromkeys((".pkl", ".pickle"), "pickles can run code when they are read; save arrays as .npz"),
    **dict.fromkeys((".gz", ".zip", ".xz", ".bz2", ".zst"), "decompress the file first"),
    **dict.fromkeys((".xls", ".xlsx", ".ods"), "save the sheet as .csv"),
    ".mat": "save the arrays as .npz, with scipy.io.loadmat and np.savez",
}


def choose_reader(path: Path, wanted: Selection) -> Reader:
    """Return the reader that recognises a file or folder, and uses all given options; refuse other files."""
    folder = stat.S_ISDIR(path.stat().st_mode)
    suffix = _FOLDER if folder else path.suffix.lower()
    if suffix in _REMEDIES:
        raise RecordingError(f"{path}: {suffix} files are not read; {_REMEDIES[suffix]}.")
    candidates = [reader for reader in READERS if suffix in reader.suffixes]
    if not candidates and not folder:
        suffixes = dict.fromkeys(each for reader in READERS for each in reader.suffixes if each != _FOLDER)
        raise RecordingError(f"{path}: expected one of {', '.join(suffixes)}, not the suffix {suffix!r}.")
    head = b""
    if not folder or not any(reader.recognises(path, head) for reader in candidates):
        with path.open("rb") as file:  # for a folder without a recording, this raises an OSError
            head = head_in_utf8(file.read(_HEAD))
    for reader in candidates:
        if reader.recognises(path, head):
            if other := [name for name in wanted.given if name not in reader.options]:
                used = ", ".join(map(flag, sorted(reader.options))) or "none"
                problem = f"is {reader.name}, which does not use {flag(other[0])}"
                raise RecordingError(f"{path}: {problem}; its options: {used}.")
            return reader
    names = " or ".join(reader.name for reader in candidates)
    remedy = "" if b"\0" in head else "; if it is a table of numbers, give it the suffix .csv"
    raise RecordingError(f"{path}: expected {names}; the content has another format{remedy}.")
