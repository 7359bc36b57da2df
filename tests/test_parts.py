"""Parts on disk: damage, copies and foreign options are found out, and named."""

import contextlib
import json
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import reframe_jax as rf
from reframe_jax.simulation import synthetic
from reframe_jax.storage import results
from reframe_jax.storage.parts import NPZ, PARQUET, Codec, Run, read_part, write_part
from reframe_jax.storage.records import describe, describe_options

pytest.importorskip("pyarrow")

CODECS = pytest.mark.parametrize("codec", [NPZ, PARQUET], ids=["npz", "parquet"])
OPTIONS = {"kind": "numbers", "bounds": [1.0, 2.0]}


def numbers() -> dict[str, np.ndarray]:
    """What results hold: floats with NaN and both zeros, whole numbers, truth values, lists of lists."""
    rng = np.random.default_rng(0)
    floats = rng.normal(size=(16, 2, 3))
    floats[3], floats[4], floats[5] = np.nan, 0.0, -0.0
    return {
        "floats": floats,
        "single": floats[:, 0].astype(np.float32),
        "codes": rng.integers(0, 4, 16).astype(np.int32),
        "flags": rng.random((16, 4)) < 0.5,
    }


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(
        a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes() for name in a
    )


@CODECS
def test_a_part_holds_what_was_written(codec: Codec, tmp_path: Path) -> None:
    file = tmp_path / f"part-00000003{codec.suffix}"
    write_part(file, codec, numbers(), OPTIONS, source="abc")
    arrays, options = read_part(file, codec, OPTIONS, source="abc")
    assert same(arrays, numbers())
    assert options == OPTIONS
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


@CODECS
def test_every_flipped_bit_is_found_out_or_changes_nothing(codec: Codec, tmp_path: Path) -> None:
    file = tmp_path / f"part-00000000{codec.suffix}"
    write_part(file, codec, numbers(), OPTIONS)
    sound, rng = file.read_bytes(), np.random.default_rng(1)
    found_out = 0
    for place in rng.integers(0, len(sound), 200):
        flipped = bytearray(sound)
        flipped[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(flipped)
        with contextlib.suppress(ValueError):
            arrays, options = read_part(file, codec)
            assert same(arrays, numbers())
            assert options == OPTIONS
            continue
        with pytest.raises(ValueError, match=re.escape(str(file))):
            read_part(file, codec)
        found_out += 1
    assert found_out > 100


@CODECS
@pytest.mark.parametrize("content", [b"", b"PAR1", b"\x00" * 64, "half", "other"])
def test_a_file_that_is_no_part_is_named(codec: Codec, content: Any, tmp_path: Path) -> None:
    file = tmp_path / f"part-00000000{codec.suffix}"
    if content == "half":
        write_part(file, codec, numbers(), OPTIONS)
        content = file.read_bytes()[: file.stat().st_size // 2]
    elif content == "other":  # the same format, not written by this library's parts
        codec.write(file, numbers(), "{}")
        content = file.read_bytes()
    file.write_bytes(content)
    with pytest.raises(ValueError, match=rf"{file.name} is damaged: delete the file"):
        read_part(file, codec)


@CODECS
def test_a_part_is_what_its_name_says(codec: Codec, tmp_path: Path) -> None:
    one, two = (tmp_path / f"part-0000000{i}{codec.suffix}" for i in (1, 2))
    write_part(one, codec, numbers(), OPTIONS, source="abc")
    shutil.copy(one, two)
    with pytest.raises(ValueError, match=rf"{two.name} is a copy of part-00000001"):
        read_part(two, codec)
    with pytest.raises(ValueError, match=rf"{one.name} was made with other options .*\(bounds, more\)"):
        read_part(one, codec, {**OPTIONS, "bounds": 1.0, "more": 1})
    with pytest.raises(ValueError, match=rf"{one.name} contains results of other windows"):
        read_part(one, codec, OPTIONS, source="abd")
    with pytest.raises(FileNotFoundError):
        read_part(tmp_path / f"part-00000009{codec.suffix}", codec)


def test_a_folder_in_the_place_of_a_part_is_named(tmp_path: Path) -> None:
    part = tmp_path / "out" / "part-00000000.npz"
    part.mkdir(parents=True)
    with pytest.raises(ValueError, match=rf"{part.name} is damaged: .*folder"):
        Run(tmp_path / "out", NPZ, "numbers", {"a": 1}).resume()


def test_contents_of_another_kind_are_named(tmp_path: Path) -> None:
    Run(tmp_path / "out", NPZ, "numbers", {"a": 1}).write(0, numbers())
    with pytest.raises(ValueError, match="contains no letters, but numbers"):
        Run.open(tmp_path / "out", NPZ, "letters")
    with pytest.raises(ValueError, match=r"contains no numbers \(part-\*\.npz\)"):
        Run.open(tmp_path, NPZ, "numbers")


def test_a_run_begun_elsewhere_in_the_meantime(tmp_path: Path) -> None:
    """Two machines begin with different options in the same empty folder: the second is refused."""
    first, second = (Run(tmp_path / "out", NPZ, "numbers", {"a": a}) for a in (1, 2))
    first.resume()
    second.resume()
    first.write(0, numbers())
    with pytest.raises(ValueError, match=r"other options \(a\)"):
        second.write(1, numbers())
    assert list(first.parts) == [0]


@pytest.fixture(scope="module")
def windows() -> np.ndarray:
    """(24, 21, 4, 4): enough for three parts of eight."""
    keys = jax.random.split(jax.random.key(0), 24)
    simulate = jax.vmap(lambda key: synthetic.simulate("K", key, noise=1e-4, duration=2.0).poses)
    return np.asarray(jax.jit(simulate)(keys))


@pytest.fixture
def identify_many(windows: np.ndarray) -> Any:
    """The windows identified in parts of eight."""
    return partial(rf.identify_many, windows, dt=0.1, part_size=8)


def test_results_that_were_tampered_with(identify_many: Any, tmp_path: Path) -> None:
    out = identify_many(tmp_path / "out")
    parts = [out / f"part-0000000{i}.parquet" for i in range(3)]
    sound = [file.read_bytes() for file in parts]
    uses = (lambda: identify_many(out), lambda: rf.load_results(out), lambda: rf.load_results(out, [2]))
    shutil.copy(parts[1], parts[2])
    for use in uses:
        with pytest.raises(ValueError, match=r"part-00000002\.parquet is a copy of part-00000001"):
            use()
    flipped = bytearray(sound[2])
    for place in range(len(flipped) // 3, len(flipped) // 3 + 64):  # a single byte may mean nothing
        flipped[place] ^= 4
    parts[2].write_bytes(flipped)
    for use in uses:
        with pytest.raises(ValueError, match=r"part-00000002\.parquet is damaged"):
            use()
    parts[2].unlink()
    identify_many(out)
    assert [file.read_bytes() for file in parts] == sound


def test_results_are_not_relabelled(identify_many: Any, tmp_path: Path) -> None:
    out = identify_many(tmp_path / "out")
    for changed, words in (
        ({"bounds": 0.5}, "bounds"),
        ({"scales": 1}, "scales"),
        ({"part_size": 9}, "part_size"),
    ):
        with pytest.raises(
            ValueError, match=rf"part-00000000\.parquet was made with other options \({words}\)"
        ):
            identify_many(out, **changed)
    with pytest.raises(ValueError, match=r"other options \(windows\)"):
        rf.identify_many(identify_many.args[0][:16], out, dt=0.1, part_size=8)
    assert len(rf.load_results(out).status_code) == 24


def test_refused_options_leave_no_trace(identify_many: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for wrong in (
        {"bounds": -1.0},
        {"thresholds": rf.Thresholds(-1.0, 1.0)},
        {"norm": 3.0},
        {"discretization": "middle"},
        {"parts": [99]},
    ):
        with pytest.raises((ValueError, KeyError)):
            identify_many(out, **wrong)
        assert not out.exists(), wrong
    with pytest.raises(TypeError, match=r"identify has no option bound; choose from scales, assume, norm, "):
        identify_many(out, bound=1.0)
    assert not out.exists()
    assert len(rf.load_results(identify_many(out)).status_code) == 24


def test_results_of_another_version_are_refused(identify_many: Any, tmp_path: Path) -> None:
    out = identify_many(tmp_path / "out", parts=[0])
    (file,) = out.glob("part-*.parquet")
    arrays, options = read_part(file, PARQUET)
    del arrays["linear.amplitude"]
    write_part(file, PARQUET, arrays, options)
    with pytest.raises(ValueError, match=r"another version of reframe_jax \(without 'linear.amplitude'\)"):
        rf.load_results(out, [0])


def test_parts_that_there_are_not(identify_many: Any, windows: np.ndarray, tmp_path: Path) -> None:
    for wrong, message in (
        ([99], r"no parts \[99\]: 24 windows make 3 parts of 8"),
        ([3, 0], r"no parts \[3\]"),
        ([-1], r"no parts \[-1\]"),
        ([0.5], "parts must be whole numbers"),
        (["0"], "parts must be whole numbers"),
        (2, "parts must be whole numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            identify_many(tmp_path / "out", parts=wrong)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match=r"no parts \[7\]: 24 windows"):
        rf.identify_many(iter(windows), tmp_path / "all", dt=0.1, part_size=8, parts=[0, 7])


def test_new_options_of_identify_are_recorded(
    identify_many: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Whatever keyword it gets, a run does not go on with another value of it."""
    identify = results.identify

    def longer(poses: Any, *, pace: int = 1, **options: Any) -> rf.Identification:
        return identify(poses, **options)

    record = describe_options(identify, {}, without=("times", "dt"))
    assert record.keys() == {"norm", "discretization", "thresholds", "bounds", "solver", "key", *record}
    monkeypatch.setattr(results, "identify", longer)
    out = rf.identify_many(identify_many.args[0], tmp_path / "out", dt=0.1, part_size=8, parts=[0], pace=2)
    assert read_part(out / "part-00000000.parquet", PARQUET)[1]["pace"] == 2
    with pytest.raises(ValueError, match=r"other options \(pace\)"):
        rf.identify_many(identify_many.args[0], out, dt=0.1, part_size=8, parts=[0])


def made(size: float) -> Any:
    return lambda t: size * t


def test_descriptions_differ_where_values_do() -> None:
    """And only there; not in the address of a function, or the kind of a number."""
    transform = partial(optax.adam, 1e-2)
    equal = (
        (1, 1.0, np.float32(1), jnp.ones(())),
        ((0.0, 1.0), [0, 1], np.array([0.0, 1.0])),
        (made(2.0), made(2.0)),
        (transform(), transform()),
        (partial(made, 1), partial(made, 1)),
        (jax.jit(made), made),
        (jax.random.key(3), jax.random.key(3)),
    )
    different = (
        (float("inf"), float("-inf"), float("nan"), None, "1", 1),
        (made(2.0), made(3.0), made),
        (transform(), optax.adam(1e-3), optax.sgd(1e-2)),
        (partial(made, 1), partial(made, 2)),
        (lambda t: t + 1, lambda t: t + 2, lambda t: t),
        (jax.random.key(3), jax.random.key(4), jax.random.key(3, impl="rbg")),
        (np.zeros(65), np.zeros(66), np.eye(65)[0], np.zeros(64)),
        (rf.LinearType.GB, rf.LinearType.BG, rf.AngularType.B, 1),
        (rf.ValleySteps(2), rf.ValleySteps(3), rf.FrameSteps(2)),
    )
    for values in equal:
        records = [json.loads(json.dumps(describe(value), allow_nan=False)) for value in values]
        assert all(record == records[0] for record in records), values
    for values in different:
        records = [json.loads(json.dumps(describe(value), allow_nan=False)) for value in values]
        assert all(a != b for i, a in enumerate(records) for b in records[:i]), values
    around: list[Any] = [1]
    around.append(around)
    assert describe(around) == [1, "itself"]
