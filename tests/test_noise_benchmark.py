"""The benchmark of noise: fits that find exact lines, scores against made errors, and a run in miniature."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reframe_jax as rf
from benchmarks import fits, noise, weak_axes
from benchmarks.bounds import cramer_rao
from benchmarks.determined import Determination, determined
from benchmarks.motions import random_motion
from reframe_jax.simulation.motions import PoseErrors

STEPS, DT = 50, 0.1


COUNT = 5  # windows throughout: other shapes would be other programs


def windows(label: str, sigma: float) -> fits.Windows:
    def of_key(key: jax.Array):
        return random_motion(label, key, samples=STEPS, dt=DT, excitation="sine", errors=PoseErrors(sigma))

    made = jax.vmap(of_key)(jax.random.split(jax.random.key(7), COUNT))
    bound = cramer_rao(made.truth, made.exact_poses, sigma, 3.0)
    poses, exact = np.asarray(made.poses), np.asarray(made.exact_poses)
    return fits.Windows(
        label, made.truth, poses, exact, DT, bound, Determination(*np.ones((2, COUNT), dtype=bool))
    )


@pytest.mark.parametrize(
    ("name", "label"), [(name, label) for name, (labels, _) in fits.LINE_FITS.items() for label in labels]
)
def test_line_fits_find_the_axis_of_exact_poses_and_stay_near_the_bound_with_noise(name, label):
    fit = fits.LINE_FITS[name][1]
    exact, noisy = windows(label, 1e-9), windows(label, 1e-4)
    for quantity, error in fits.line_scores(fit(exact.poses), exact).errors.items():
        unique = getattr(noisy.bound, quantity)[0, 0]
        if np.isnan(unique):
            assert np.isnan(error).all()
            continue
        assert error.max() < 1e-6
        scored = fits.line_scores(fit(noisy.poses), noisy)
        ratio = scored.errors[quantity] / scored.bounds[quantity]
        assert (
            0.3 < np.median(ratio) < 8
        )  # of the mean: a sine may repeat after half a window, or hardly turn


def test_a_slope_is_that_of_the_medians():
    rows = [
        {"contestant": "identify", "rate": rate, "angular_median_deg": None, "linear_median_deg": 3 / rate}
        | {"position_median_mm": 5 * np.sqrt(rate)}
        for rate in (10.0, 30.0, 90.0)
    ] + [{"contestant": "scales=1", "rate": 500.0, "position_median_mm": 1.0}]
    found = noise.slopes(rows, "rate")
    np.testing.assert_allclose(found["linear_slope_by_rate"], -1)
    np.testing.assert_allclose(found["position_slope_by_rate"], 0.5)
    assert set(found) == {"linear_slope_by_rate", "position_slope_by_rate"}


def test_what_nobody_can_tell_is_left_out():
    table, count = noise.Table(), 3
    bounds = {name: np.array([1e-3, 0.5, np.nan]) for name in fits.QUANTITIES}
    errors = {name: np.array([2e-3, 0.7, np.nan]) for name in fits.QUANTITIES}
    right = {name: np.array([True, False, True]) for name in ("types", "dof", "name")}
    where = {"rate": np.full(count, 10.0)}
    table.add("identify", where, fits.Scores(errors, bounds, right))
    (row,) = noise.summarise(table.joined(), ["rate"])
    np.testing.assert_allclose(row["position_median_mm"], 2.0)
    np.testing.assert_allclose(row["position_rms_mm"], 2.0)
    np.testing.assert_allclose(row["position_ratio"], 2.0)
    np.testing.assert_allclose(row["types_right"], 2 / 3)
    assert row["windows"] == count


@pytest.mark.parametrize(
    ("label", "excitation", "sigma", "dof", "name"),
    [
        ("A", "sine", 1e-4, True, True),
        ("E", "sine", 1e-4, True, True),
        ("E", "paper", 1e-4, False, False),  # it turns and slides steadily: on a circle
        ("J", "paper", 1e-4, True, False),  # it turns steadily: E explains it as well
        ("G", "paper", 1e-4, False, False),
        ("K", "sine", 1e-4, True, True),
        ("K", "sine", 1.0, False, False),  # the noise is larger than the motion
    ],
)
def test_a_motion_tells_the_constraint_if_nothing_as_tight_explains_it(label, excitation, sigma, dof, name):
    errors = PoseErrors(sigma, rotation_ratio=3.0)
    motion = random_motion(
        label, jax.random.key(1), samples=STEPS, dt=DT, excitation=excitation, errors=errors
    )
    exact, measured = np.asarray(motion.exact_poses)[None], np.asarray(motion.poses)[None]
    truth = jax.tree.map(lambda leaf: leaf[None], motion.truth)
    determination = determined(label, truth, exact, measured, DT, np.array([sigma]), np.array([3.0]))
    assert (determination.dof, determination.name) == ([dof], [name])


def test_windows_that_the_motion_does_not_determine_are_not_scored():
    ours = windows("A", 1e-4)
    dof, name = np.array([True, False, True, True, False]), np.array([True, False, False, True, False])
    some = replace(ours, determination=Determination(dof, name))
    right = fits.scores(rf.identify(ours.poses, dt=DT), some).right
    np.testing.assert_array_equal(right["determined"], dof)
    for each in ("types", "dof", "confident_wrong"):
        np.testing.assert_array_equal(np.isnan(right[each]), ~dof)
    np.testing.assert_array_equal(np.isnan(right["name"]), ~name)


def test_a_run_in_miniature(tmp_path, capsys):
    file = tmp_path / "out.json"
    options = ["--constraints", "A", "K", "--motions", "exciting", "--sigmas", "1e-6", "--rates", "10"]
    assert noise.main([*options, "--windows", str(COUNT), "--annealed", "1", "--json", str(file)]) == 0
    record = json.loads(file.read_text())
    rows = {(row["constraint"], row["contestant"]): row for row in record["rows"]}
    assert {("A", "identify"), ("K", "identify"), ("A", "circle fit"), ("K", "dual annealing")} <= set(rows)
    for label in "AK":
        row = rows[label, "identify"]
        assert row["windows"] == COUNT
        assert min(row["types_right"], row["dof_right"], row["name_right"]) > 0.9
        assert 0 < row["position_bound_mm"] / 3 < row["position_rms_mm"] < 1  # of a few windows
    assert rows["K", "dual annealing"]["linear_median_deg"] < 1
    printed = capsys.readouterr()
    for table in ("By constraint", "By standard deviation", "By sampling rate", "compile"):
        assert table in printed.out
    assert "10 Hz" in printed.err


@pytest.mark.parametrize("kind", list(rf.LinearType))
def test_a_hinge_is_scored_in_the_body_its_winner_is_in(kind):
    ours = windows("A", 1e-6)
    here = rf.LinearType.BB if kind.position_body == rf.AngularType.B else rf.LinearType.GG
    truth, found = fits._express_in_type(ours, here), rf.identify(ours.poses, dt=DT)
    shift = 0.01 * truth.linear_axes[:, :, 0]
    shifted = found.candidates.linear.position.at[:, int(kind)].set(truth.position + shift)
    linear = replace(found.candidates.linear, position=shifted)
    moved = replace(
        found,
        candidates=replace(found.candidates, linear=linear),
        linear=replace(found.linear, type_code=jnp.full(COUNT, int(kind))),
    )
    np.testing.assert_allclose(fits.scores(moved, ours).errors["position"], 0.01, rtol=1e-6)


def test_weak_axes_are_grouped_and_the_wrong_ones_listed(tmp_path, capsys):
    file, again = tmp_path / "out.json", tmp_path / "again.json"
    assert weak_axes.main(["--quick", "--json", str(file)]) == 0
    printed = capsys.readouterr().out
    record = json.loads(file.read_text())
    rows = [weak_axes.Window(**row) for row in record["windows"]]
    assert {row.constraint for row in rows} <= {"D", "K"}
    assert all(row.noises > 10 and 0 < row.ratio < 2 for row in rows)  # determined
    assert record["metrics"]["windows"] == len(rows) > 0
    wrong = replace(rows[0], right=False, probability=0.95, ratio=0.005, name="Fixed")
    metrics = weak_axes.print_table([*rows, wrong])
    assert metrics["sure_and_wrong"] == record["metrics"]["sure_and_wrong"] + 1
    assert ": Fixed (0.95)" in capsys.readouterr().out
    assert weak_axes.main(["--join", str(file), "--json", str(again)]) == 0
    assert capsys.readouterr().out == printed
    assert json.loads(again.read_text()) == record
