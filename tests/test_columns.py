"""Flat columns: in a data frame, in Parquet and in CSV."""

import builtins
import csv
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.export.columns import to_columns, write_csv, write_parquet
from reframe_jax.export.common import Window
from reframe_jax.simulation import synthetic


@pytest.fixture(scope="module")
def batch() -> rf.Identification:
    """Four windows of a hinge; the last one has no result."""
    poses = synthetic.simulate("A", jax.random.key(0), noise=1e-4).poses
    windows = rf.sliding_windows(np.asarray(poses), 21, stride=10).copy()
    windows[3] = windows[3, :1]
    return jax.device_get(rf.identify(windows, dt=0.1))


def test_a_row_is_a_window(batch: rf.Identification) -> None:
    pandas = pytest.importorskip("pandas")
    spans = [Window(10 * i, 10 * i + 21, i * 1.0, i + 2.0) for i in range(4)]
    frame = rf.to_frame(batch, label="door", windows=spans)
    assert isinstance(frame, pandas.DataFrame)
    assert frame["recording"].tolist() == ["door"] * 4
    assert frame["window"].tolist() == [0, 1, 2, 3]
    assert frame["start"].tolist() == [0, 10, 20, 30]
    assert frame["stop_time_s"].tolist() == [2, 3, 4, 5]
    assert frame["status"].tolist()[2:] == ["OK", "NO_MOTION"]
    assert frame["name"].tolist() == ["Revolute joint"] * 3 + [""]
    assert frame["label"].tolist() == ["A"] * 3 + [""]
    assert frame["linear_type"][0] == str(batch[0].linear.frame_type)
    assert set(frame["linear_tied"][0].split()) == {
        str(kind) for kind in rf.LinearType if batch[0].linear.tied[kind]
    }
    for i, name in enumerate("xyz"):
        np.testing.assert_array_equal(frame[f"linear_position_{name}_m"], batch.linear.position[:, i])
        np.testing.assert_allclose(frame[f"angular_axis_3_{name}"][0], batch[0].angular.axes[i, 2])
    for axis in range(3):
        np.testing.assert_array_equal(frame[f"angular_rms_{axis + 1}_rad_s"], batch.angular.rms[:, axis])
        np.testing.assert_array_equal(frame[f"linear_free_{axis + 1}"], batch.linear.dof[:, axis] == 1)
    np.testing.assert_array_equal(frame["probability"], batch.probability)
    assert frame["linear_open_directions"].tolist() == [1, 1, 1, 0]
    for axis in range(3):
        np.testing.assert_array_equal(
            frame[f"linear_amplitude_{axis + 1}_m"], batch.linear.amplitude[:, axis]
        )
        np.testing.assert_array_equal(
            frame[f"angular_amplitude_{axis + 1}_rad"], batch.angular.amplitude[:, axis]
        )


def test_columns_are_flat_and_typed(batch: rf.Identification) -> None:
    columns = to_columns(batch)
    kinds = {name: column.dtype.kind for name, column in columns.items()}
    assert set(kinds.values()) == {"O", "i", "f", "b"}
    assert all(column.shape == (4,) for column in columns.values())
    # what has a unit has it in its name; axes are unit vectors
    unitless = r"probability|universal_\w+_[xyz]|.*_axis_\d_[xyz]|.*_free_probability_\d"
    for name, kind in kinds.items():
        if kind == "f" and not re.fullmatch(unitless, name):
            assert re.search(r"_(m|s|rad|m_s|rad_s|m_rad)$", name), name
    assert columns["start"].tolist() == [-1] * 4
    one = to_columns(batch[0])
    assert {name: column.dtype for name, column in one.items()} == {
        name: column.dtype for name, column in columns.items()
    }
    assert one["linear_position_x_m"].shape == (1,)
    two = to_columns(jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), batch))
    np.testing.assert_array_equal(two["linear_position_x_m"], columns["linear_position_x_m"])
    assert two["name"].tolist() == columns["name"].tolist()


def test_parquet_has_the_same_columns(batch: rf.Identification, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "out.parquet"
    first, second = to_columns(batch, label="a"), to_columns(batch, label="b")
    write_parquet(path, [first, second])
    table = parquet.read_table(path)
    assert table.column_names == list(first)
    assert table["recording"].to_pylist() == ["a"] * 4 + ["b"] * 4
    types = {"O": {"string", "large_string"}, "i": {"int64"}, "f": {"double"}, "b": {"bool"}}
    for name, column in first.items():
        assert str(table[name].type) in types[column.dtype.kind], name
    frame = table.to_pandas()
    np.testing.assert_array_equal(frame["linear_norm_m_s"][:4], first["linear_norm_m_s"])
    rf.to_frame(batch, label="a").to_parquet(tmp_path / "pandas.parquet")
    assert parquet.read_table(tmp_path / "pandas.parquet").column_names == list(first)


def test_csv_reads_back(batch: rf.Identification, tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    columns = to_columns(batch, label='a, "b"')
    write_csv(path, [columns, columns])
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert list(rows[0]) == list(columns)
    assert rows[5]["recording"] == 'a, "b"'
    for name, column in columns.items():
        written = [row[name] for row in rows[:4]]
        if column.dtype.kind == "f":
            np.testing.assert_array_equal([float(cell) for cell in written], column)
        else:
            assert written == [str(value) for value in column.tolist()]


def test_windows_must_be_as_many(batch: rf.Identification) -> None:
    with pytest.raises(ValueError, match="Expected 4 windows, one per identification, not 1"):
        to_columns(batch, windows=[Window(0, 21, 0.0, 2.0)])


@pytest.mark.parametrize(("package", "extra"), [("pandas", "pandas"), ("pyarrow", "parquet")])
def test_missing_packages_are_named(
    batch: rf.Identification, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, extra: str
) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == package:
            raise ImportError(name)
        return real(name, *args, **kwargs)

    def write() -> None:
        write_parquet(tmp_path / "out.parquet", [to_columns(batch)])

    monkeypatch.setattr(builtins, "__import__", without)
    use = {"pandas": lambda: rf.to_frame(batch), "pyarrow": write}[package]
    with pytest.raises(ImportError, match=rf"pip install 'reframe-jax\[{extra}\]'"):
        use()
