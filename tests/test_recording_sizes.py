"""Recordings: files that claim or hold more than memory does."""

import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from recording_files import HEADER, check, poses_of

from reframe_jax.recordings import recording as records
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import RecordingError


def npy(descr: object, shape: tuple[int, ...], data: bytes = b"", order: bool = False) -> bytes:
    """An .npy as its header says, which need not be true."""
    text = repr({"descr": descr, "fortran_order": order, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (npy("<f8", (10**12, 4, 4)), "expected plain arrays"),
        (npy("<f8", (9, 8), bytes(575)), "expected plain arrays"),
        (npy("<f8", (-9, -8), bytes(576)), "expected plain arrays"),
        (npy("<c16", (9, 8), bytes(1152)), r"expected numbers: .* found poses \(9, 8\) of complex128"),
        (npy("<M8[s]", (9, 8), bytes(576)), r"expected numbers: .* found poses \(9, 8\) of datetime64\[s\]"),
        (npy("<U1", (9, 8), bytes(288)), r"expected numbers: .* found poses \(9, 8\) of <U1"),
        (npy([("a", "<f8")], (9, 8), bytes(576)), "expected numbers"),
        (npy("|b1", (9, 8), bytes(72)), "expected numbers"),
        (npy("|O", (9, 8), bytes(576)), "expected plain arrays"),
        (npy(7, (9, 8), bytes(576)), "expected plain arrays"),
        (npy("<f8", (9, 8), bytes(576)).replace(b"(9, 8)", b"(9, 8("), "expected plain arrays"),
        (npy("<f8", (2**24, 7), b"")[:-1] + b" " * 20000, "expected plain arrays"),
    ],
)
def test_headers_are_not_believed(tmp_path: Path, content: bytes, problem: str) -> None:
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", content)
    for path in (tmp_path / "a.npy", tmp_path / "a.npz"):
        with pytest.raises(RecordingError, match=problem) as caught:
            load_recording(path, dt=0.1)
        assert str(caught.value).startswith(str(path))


def test_recordings_of_too_many_samples_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 2**23 + 1
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", npy("|u1", (count, 7), bytes(7 * count)))
    with pytest.raises(RecordingError, match="has more than 8388608 rows"):
        load_recording(tmp_path / "a.npz", dt=0.1)
    monkeypatch.setattr(records, "MOST_ROWS", 8)
    (tmp_path / "a.txt").write_text("0 0 0 0 0 0 0 1\n" * 9)
    with pytest.raises(RecordingError, match="has more than 8 rows; divide"):
        load_recording(tmp_path / "a.txt")


def test_other_arrays_of_an_archive_are_not_read(tmp_path: Path, table: np.ndarray) -> None:
    np.savez_compressed(tmp_path / "a.npz", poses=poses_of(table), times=table[:, 0], large=np.zeros(2**25))
    tracemalloc.start()
    check(tmp_path / "a.npz", table)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_text_is_read_line_by_line(tmp_path: Path, table: np.ndarray) -> None:
    rows = 20_000
    line = ",".join(map(repr, table[0, 1:].tolist()))
    (tmp_path / "a.csv").write_text(
        ",".join(HEADER) + "\n" + "".join(f"{1_600_000_000 + k},{line}\n" for k in range(rows))
    )
    tracemalloc.start()
    recording = load_recording(tmp_path / "a.csv")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(recording.times) == rows
    assert peak < 20e6  # the poses alone take 2.6 MB, blocks of intermediate values up to 10 MB


@pytest.mark.parametrize("name", ["a.csv", "a.txt"])
def test_lines_that_never_end_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(bytes(2**17))
    with pytest.raises(RecordingError, match="line 1: is longer than 65536 characters"):
        load_recording(tmp_path / name)


def test_messages_quote_files_in_small(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,\x1b[31m" + 5000 * "x" + "\n0,0\n0,0\n")
    with pytest.raises(RecordingError) as caught:
        load_recording(tmp_path / "a.csv")
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()
