"""Demonstrations on disk: they go on where they stopped, and only there."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from reframe_jax.simulation import arm as panda
from reframe_jax.storage.records import describe_options

BATCH = 8  # the shape that other tests compile
KEY = jax.random.key(11)


def pushed(size: float) -> Any:
    """An excitation; two of these differ in their address."""

    def push(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.full(3, size) * jnp.sin(t), 0.1 * jnp.cos(t) * jnp.ones(3)

    return push


def load(folder: Path) -> panda.Demonstration:
    """All demonstrations of a folder as one batch."""
    parts = list(panda.stored_demonstrations(folder))
    made: panda.Demonstration = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return replace(made, times=parts[0].times)


def test_stored_demonstrations_go_on_where_they_stopped(tmp_path: Path) -> None:
    options = {"chunk": BATCH, "spread": panda.SPREAD}
    folder = panda.store_demonstrations("K", KEY, 4, tmp_path / "demos", **options)
    first = folder / "part-00000000.npz"
    written = first.stat().st_mtime_ns
    panda.store_demonstrations("K", KEY, 12, folder, **options)
    assert first.stat().st_mtime_ns == written
    made = load(folder)[:12]
    drawn = list(panda.demonstrations("K", KEY, 12, **options))
    np.testing.assert_array_equal(made.poses, np.concatenate([part.poses for part in drawn]))
    assert made.truth.linear_type == rf.LinearType.GB
    windows = (poses for part in panda.stored_demonstrations(folder) for poses in part.poses)
    rf.identify_many(windows, tmp_path / "found", times=made.times, part_size=BATCH)
    found = rf.load_results(tmp_path / "found")
    assert set(found.name[:12]) == {"Pin-plane contact"}
    assert made[3].truth.position.shape == (3,)
    with pytest.raises(ValueError, match="other options"):
        panda.store_demonstrations("I", KEY, 12, folder, **options)
    with pytest.raises(ValueError, match="no demonstrations"):
        load(tmp_path)


def test_what_a_folder_depends_on() -> None:
    """The same in every process, which the address of a function is not, and all of it."""
    start = np.zeros((500, 7))
    moved = start.copy()
    moved[250, 3] = 1e-3
    noises = jnp.asarray(0.5), 0.5, 0.0
    records = [
        describe_options(panda.demonstrate, options)
        for options in (
            *({"excitation": pushed(0.1)} for _ in range(2)),
            *({"start": values} for values in (start, start.copy(), moved)),
            *({"imperfections": panda.Imperfections(encoder_noise=noise)} for noise in noises),
        )
    ]
    same = [a == b for a, b in pairwise(records)]
    assert same == [True, False, True, False, False, True, False]


def test_folders_of_something_else(tmp_path: Path) -> None:
    """They are left as they are; a run that failed before its first part is in nobody's way."""
    options = {"chunk": BATCH, "spread": panda.SPREAD}
    folder = tmp_path / "demos"
    for wrong, error, words in (
        (("K", {"dt": -1.0}), ValueError, "0 < dt <= duration"),
        (("nothing", {}), KeyError, "No constraint 'nothing'"),
    ):
        with pytest.raises(error, match=words):
            panda.store_demonstrations(wrong[0], KEY, 4, folder, **options, **wrong[1])
        assert not folder.exists()
    panda.store_demonstrations("K", KEY, 4, folder, **options)
    part = folder / "part-00000000.npz"
    part.write_bytes(part.read_bytes()[:1000])
    for use in (
        lambda: panda.store_demonstrations("K", KEY, 4, folder, **options),
        lambda: load(folder),
    ):
        with pytest.raises(ValueError, match="is damaged"):
            use()
    part.unlink()
    panda.store_demonstrations("K", KEY, 4, folder, **options)
    with pytest.raises(ValueError, match=r"made with other options .*\(constraint\)"):
        panda.store_demonstrations("I", KEY, 4, folder, **options)
    shutil.copy(part, folder / "part-00000001.npz")
    for use in (
        lambda: panda.store_demonstrations("K", KEY, 99, folder, **options),
        lambda: load(folder),
    ):
        with pytest.raises(ValueError, match=r"part-00000001\.npz is a copy of part-00000000"):
            use()
    (folder / "part-00000001.npz").unlink()
    panda.store_demonstrations("K", KEY, 12, folder, **options)
    part.unlink()
    with pytest.raises(ValueError, match=r"parts \[0\] are missing. Run store_demonstrations again"):
        load(folder)
