"""Make damaged files: recordings of every format with flipped, deleted and replaced bytes."""

import io
import zipfile
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["FORMATS", "ROWS", "TOKENS", "TYPES", "make_recording", "motion", "mutated"]

ROWS = 12

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
    """Random motion of a body, (12, 8): t, x, y, z, qx, qy, qz, qw."""
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
    """Replace a part of the header of an .npy file, and correct the length of the header."""
    length = int.from_bytes(content[8:10], "little")
    header = content[10 : 10 + length].replace(old.encode(), new.encode())
    return content[:8] + len(header).to_bytes(2, "little") + header + content[10 + length :]


def make_npz(rng: np.random.Generator) -> bytes:
    """Make an archive whose members may be mutated, with any compression."""
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
    """Choose a part of a file, of any length or only a few bytes."""
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
    """Replace the text between two separators, which is a cell of a text file."""
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


FORMATS: dict[str, Callable[[np.random.Generator], bytes]] = {
    ".csv": make_csv,
    ".tum": make_tum,
    ".npy": make_npy,
    ".npz": make_npz,
}


def make_recording(
    rng: np.random.Generator, suffix: str, make: Callable[[np.random.Generator], bytes] | None = None
) -> bytes:
    """Make a mutated file of a format, with a given function or one of the functions above."""
    content = (FORMATS[suffix] if make is None else make)(rng)
    # most changes to an archive break a checksum, so half of the archives have mutated members only
    whole = suffix == ".npz" and rng.random() < 0.5
    return content if whole else mutated(rng, content)
