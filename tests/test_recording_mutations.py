"""Files as accidents leave them: each is a valid recording, or refused in words; nothing else, no warning."""

import io
import tempfile
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bag_files import POSE, START, Messages, write_bag
from export_files import motive, qualisys, vicon
from recording_files import poses_of
from scipy.spatial.transform import Rotation

from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError

FEW, MANY = 100, 6000  # files of each format
ROWS = 12
MOST_MEMORY = 2**24  # bytes; 2**20 are enough for these files

TOKENS = [
    *(b"nan", b"inf", b"-1e999", b"1e999", b"1e308", b"-1e308", b"1e-400", b"0e99999999999999999999", b""),
    *(b"1_0", b"0x10", b"1+2j", b"True", b"12:30", b"2020-01-01", b"9" * 400, b"1600000000.123456789"),
    *(b'"', b'""', b"'", b"\0", b"\xff", b"\xef\xbb\xbf", b"\r", b"\x1b[2J", b"\xe2\x80\xa8", b"\\", b"\\d"),
    *(b",", b";", b"\t", b"#", b"%", b"\n\n", b" ", b"(", b"]" * 300, b"(" * 300, b"x" * 70_000),
    *(b"x,x", b"t", b"qx", b"fx", b"m00", b"pos_x", b"snan", "٣".encode(), b"-", b"None", b"1" * 5000),
]
SHAPES = [
    *("(12, 8)", "(12, 7)", "(12,)", "()", "(0, 8)", "(12, 4, 4)", "(3, 4, 8)", "(1000000000000, 8)"),
    *("(9999999999999999999999, 8)", "(-12, 8)", "(12, -8)", "(12.0, 8)", "(None, 8)", "('a', 8)", "(12, 8"),
    *("(12L, 8L)", "[12, 8]", "12", "(True, 8)", "(2, 48)", "(96,)", "(96, 1)", "(6, 8)", "(5, 7)"),
]
TYPES = [
    *("'<f8'", "'>f8'", "'<f4'", "'<f2'", "'<f16'", "'<i8'", "'<u8'", "'|i1'", "'|u1'", "'<c16'", "'<c8'"),
    *("'|b1'", "'<U2'", "'|S8'", "'<M8[s]'", "'<m8[ns]'", "'<M8'", "'|O'", "'|V8'", "'|V0'", "'<U0'", "'f'"),
    *("[('a', '<f8')]", "[('a', '<f4'), ('b', '<f4')]", "[('a', '<f8', (2,))]", "('<f8', (2,))", "7", "None"),
    *(
        "[]",
        "{}",
        "'a'",
        "'<q'",
        "'<f8,<f8'",
        "[('a', '|O')]",
        "'\\d'",
        "{'names': ['a'], 'formats': ['<f8']}",
    ),
]

Mutation = Callable[[np.random.Generator, bytes], bytes]


def motion(rng: np.random.Generator) -> np.ndarray:
    """(12, 8): t, x, y, z, qx, qy, qz, qw of a wandering body."""
    times = np.cumsum(rng.uniform(0.02, 0.1, ROWS)) + rng.choice([0.0, 1.6e9])
    return np.column_stack([times, rng.normal(size=(ROWS, 3)), Rotation.random(ROWS, rng).as_quat()])


def text_of(table: np.ndarray, separator: str) -> bytes:
    return "".join(separator.join(map(repr, row)) + "\n" for row in table.tolist()).encode()


def make_csv(rng: np.random.Generator) -> bytes:
    return b"t,x,y,z,qx,qy,qz,qw\n" + text_of(motion(rng), ",")


def make_tum(rng: np.random.Generator) -> bytes:
    return text_of(motion(rng), " ")


def make_npy(rng: np.random.Generator, name: str = "table") -> bytes:
    table = motion(rng)
    poses = np.tile(np.eye(4), (ROWS, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(table[:, 4:]).as_matrix(), table[:, 1:4]
    arrays = {
        "table": table,
        "poses": poses,
        "positions": table[:, 1:4],
        "quaternions": table[:, 4:],
        "times": table[:, 0],
    }
    file = io.BytesIO()
    np.save(file, arrays[name])
    content = file.getvalue()
    if rng.random() < 0.15:
        content = with_header(content, "'descr': '<f8'", f"'descr': {rng.choice(TYPES)}")
    if rng.random() < 0.15:
        content = with_header(content, f"'shape': {arrays[name].shape}", f"'shape': {rng.choice(SHAPES)}")
    if rng.random() < 0.05:
        content = with_header(content, "False", str(rng.choice(["True", "1", "None", "'", "-", "(" * 300])))
    return content


def with_header(content: bytes, old: str, new: str) -> bytes:
    """An .npy with a part of its header replaced, and the length of the header told right."""
    length = int.from_bytes(content[8:10], "little")
    header = content[10 : 10 + length].replace(old.encode(), new.encode())
    return content[:8] + len(header).to_bytes(2, "little") + header + content[10 + length :]


def make_npz(rng: np.random.Generator) -> bytes:
    """An archive whose members may be mutated themselves, and packed in any way."""
    names = ["poses", "times"] if rng.random() < 0.5 else ["positions", "quaternions", "times"]
    seed = int(rng.integers(2**32))
    file = io.BytesIO()
    methods = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    with zipfile.ZipFile(file, "w", methods[rng.choice(4, p=[0.4, 0.4, 0.1, 0.1])]) as archive:
        for name in names:
            content = make_npy(np.random.default_rng(seed) if rng.random() < 0.9 else rng, name)
            if rng.random() < 0.2:
                content = mutated(rng, content)
            archive.writestr(name + ".npy", content)
    return file.getvalue()


def flip(rng: np.random.Generator, content: bytes) -> bytes:
    changed = bytearray(content)
    for where in rng.integers(len(changed), size=rng.integers(1, 6)):
        changed[where] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def span(rng: np.random.Generator, content: bytes) -> tuple[int, int]:
    """A part of a file: of any length, or a few bytes."""
    start = int(rng.integers(len(content)))
    longest = len(content) - start if rng.random() < 0.3 else 40
    return start, min(len(content), start + int(rng.integers(1, longest + 1)))


def cut(rng: np.random.Generator, content: bytes) -> bytes:
    start, stop = span(rng, content)
    return content[:start] if rng.random() < 0.5 else content[:start] + content[stop:]


def repeat(rng: np.random.Generator, content: bytes) -> bytes:
    start, stop = span(rng, content)
    return content[:stop] + content[start:]


def swap(rng: np.random.Generator, content: bytes) -> bytes:
    a, b, c, d = sorted([*span(rng, content), *span(rng, content)])
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


def insert(rng: np.random.Generator, content: bytes) -> bytes:
    start = int(rng.integers(len(content)))
    return content[:start] + TOKENS[rng.integers(len(TOKENS))] + content[start:]


def replace_cell(rng: np.random.Generator, content: bytes) -> bytes:
    """Another token between two separators: in text a cell, elsewhere some bytes."""
    marks = [i for i, byte in enumerate(content) if byte in b", \n:"]
    if len(marks) < 2:
        return insert(rng, content)
    k = int(rng.integers(len(marks) - 1))
    return content[: marks[k] + 1] + TOKENS[rng.integers(len(TOKENS))] + content[marks[k + 1] :]


def mutated(rng: np.random.Generator, content: bytes) -> bytes:
    kinds: list[Mutation] = [flip, cut, repeat, swap, insert, replace_cell]
    for _ in range(rng.integers(1, 4)):
        if content:
            content = kinds[rng.integers(len(kinds))](rng, content)
    return content


def make_motive(rng: np.random.Generator) -> bytes:
    rotation = str(rng.choice(["Quaternion", "XYZ"]))
    return motive({"Rod": poses_of(motion(rng))}, rotation=rotation, lost=(4,)).encode()


def make_vicon(rng: np.random.Generator) -> bytes:
    return vicon({"Rod": poses_of(motion(rng))}, lost=(4,)).encode()


def make_qualisys(rng: np.random.Generator) -> bytes:
    bodies = {"Rod": poses_of(motion(rng))}
    return qualisys(bodies, titles=bool(rng.random() < 0.5), lost=(4,)).encode()


def make_bag(rng: np.random.Generator, name: str) -> bytes:
    return bag(name, int(rng.integers(3)))


@cache
def bag(name: str, seed: int) -> bytes:
    messages, poses = Messages(name), poses_of(motion(np.random.default_rng(seed)))
    stamps = [START + 10**7 * k for k in range(ROWS)]
    with tempfile.TemporaryDirectory() as folder:
        samples = [
            ("/pose", POSE, messages.pose(POSE, t, pose), t) for t, pose in zip(stamps, poses, strict=True)
        ]
        return write_bag(Path(folder), name, samples).read_bytes()


def make_parquet(rng: np.random.Generator) -> bytes:
    table = motion(rng)
    columns = {"timestamp": table[:, 0], **dict(zip(["x", "y", "z"], table[:, 1:4].T, strict=True))}
    columns["q"] = pa.FixedSizeListArray.from_arrays(pa.array(table[:, 4:].ravel()), 4)
    sink = io.BytesIO()
    pq.write_table(pa.table(columns), sink)
    return sink.getvalue()


def make_hdf5(rng: np.random.Generator) -> bytes:
    table, sink = motion(rng), io.BytesIO()
    with h5py.File(sink, "w") as file:
        file["p"], file["q"] = table[:, 1:4], table[:, 4:]
    return sink.getvalue()


FORMATS = {
    **{".csv": make_csv, ".tum": make_tum, ".npy": make_npy, ".npz": make_npz},
    **{"motive.csv": make_motive, "vicon.csv": make_vicon, "qualisys.tsv": make_qualisys},
    **{".bag": partial(make_bag, name="a.bag"), ".mcap": partial(make_bag, name="a.mcap")},
    **{".parquet": make_parquet, ".hdf5": make_hdf5},
}
OPTIONS: dict[str, Any] = {
    "vicon.csv": {"angles": "vector"},
    ".parquet": {"position": "x,y,z", "orientation": "q", "quaternion": "xyzw"},
    ".hdf5": {"position": "p", "orientation": "q", "quaternion": "xyzw"},
}


def outcome(path: Path, dt: float | None, **options: Any) -> str:
    """Loads a file and checks what comes of it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            recording = load_recording(path, dt=dt, **options)
    except RecordingError as error:
        check_message(str(error), path)
        return "refused"
    times, poses = recording.times, recording.poses
    assert times.shape == (len(poses),)
    assert poses.shape == (len(times), 4, 4)
    assert len(times) >= 5
    assert np.isfinite(times).all()
    assert np.isfinite(poses).all()
    assert (times[1:] > times[:-1]).all()
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations.swapaxes(1, 2) @ rotations, np.broadcast_to(np.eye(3), rotations.shape), atol=1e-12
    )
    assert (np.linalg.det(rotations) > 0).all()
    assert (poses[:, 3] == [0, 0, 0, 1]).all()
    return "read"


def check_message(message: str, path: Path) -> None:
    assert message.startswith(f"{path}: ")
    assert len(message) < 2000
    assert message.isprintable()


def read_mutated(folder: Path, suffix: str, count: int) -> dict[str, int]:
    """Reads so many files of a format, one after the other; returns how many came out how."""
    outcomes = {"read": 0, "refused": 0}
    for seed in range(count):
        rng = np.random.default_rng([seed, *suffix.encode()])
        path = folder / f"{seed}{suffix}"
        content = FORMATS[suffix](rng)
        # most changes to an archive break a checksum: in half of them only members are mutated
        whole = suffix == ".npz" and rng.random() < 0.5
        path.write_bytes(content if whole else mutated(rng, content))
        tracemalloc.reset_peak()
        try:
            dt = 0.1 if suffix == ".hdf5" or rng.random() < 0.3 else None
            outcomes[outcome(path, dt, **OPTIONS.get(suffix, {}))] += 1
        except BaseException as error:
            error.add_note(f"of the file {path}")
            raise
        assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY, path  # where it is traced
        path.unlink()
    return outcomes


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_that_are_whole_are_read(tmp_path: Path, suffix: str) -> None:
    """The files that are mutated below are recordings."""
    makers = {**FORMATS, ".npy": whole_npy, ".npz": whole_npz}
    path = tmp_path / f"a{suffix}"
    path.write_bytes(makers[suffix](np.random.default_rng(3)))
    assert outcome(path, 0.1 if suffix == ".hdf5" else None, **OPTIONS.get(suffix, {})) == "read"


def whole_npy(rng: np.random.Generator) -> bytes:
    file = io.BytesIO()
    np.save(file, motion(rng))
    return file.getvalue()


def whole_npz(rng: np.random.Generator) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("poses.npy", whole_npy(rng))
    return file.getvalue()


@pytest.mark.parametrize("suffix", FORMATS)
def test_mutated_files_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    tracemalloc.start()
    try:
        outcomes = read_mutated(tmp_path, suffix, FEW)
    finally:
        tracemalloc.stop()
    assert min(outcomes.values()) > 0, outcomes


@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_many_mutated_files_are_read_or_refused(tmp_path: Path, suffix: str) -> None:
    outcomes = read_mutated(tmp_path, suffix, MANY)
    assert min(outcomes.values()) > MANY // 100, outcomes
