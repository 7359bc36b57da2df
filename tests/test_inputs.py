"""Numbers of every type: taken for what they are, or refused in words. No NaN under a good status."""

import decimal
from dataclasses import replace

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from contacts import simulate_contact

import reframe_jax as rf
from reframe_jax.identification import inputs
from reframe_jax.identification.inputs import read_numbers, take_steps
from reframe_jax.identification.options import take_scales
from reframe_jax.simulation import synthetic

K = 20
DT = 0.05


@pytest.fixture(scope="module")
def poses():
    """(21, 4, 4) of a hinge."""
    return np.asarray(synthetic.simulate("A", jax.random.key(2), noise=1e-4, duration=1.0, dt=DT).poses)


def identify(poses, **options):
    if not options.keys() & {"dt", "times"}:
        options["dt"] = DT
    return rf.identify(poses, **options)


def same(found, expected):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def test_constant_poses_in_a_traced_function():
    poses = simulate_contact("K", 0).poses  # as many as the program outside of a trace has
    thresholds = rf.Thresholds()  # nothing is fitted, so the programs are small

    def height():
        found = identify(poses[None], thresholds=thresholds)
        return found.linear.position[0, 2], found.linear.norm[0]

    found = identify(poses, thresholds=thresholds)
    above, norm = jax.jit(height)()
    np.testing.assert_allclose(above, found.linear.position[2], rtol=1e-6)
    np.testing.assert_allclose(norm, found.linear.norm, rtol=1e-6)


def test_arrays_of_the_other_byte_order_are_read_as_the_numbers_they_hold(poses):
    times = DT * np.arange(K + 1)
    expected = identify(poses, times=times)
    same(identify(poses.astype(">f8"), times=times.astype(">f8")), expected)
    steps = np.diff(times)
    same(identify(poses.astype("<f8"), dt=steps.astype(">f8")), identify(poses, dt=steps))
    single = identify(poses.astype(np.float32), dt=np.float32(DT))
    same(identify(poses.astype(">f4"), dt=np.float32(DT)), single)
    assert single.linear.norm.dtype == np.float32


def test_numbers_of_more_than_64_bits_are_rounded(poses):
    same(identify(poses.astype(np.longdouble), dt=np.longdouble(DT)), identify(poses))


@pytest.mark.parametrize("name", ["uint8", "uint32", "uint64", "int8", "int64", ">i2", "float32"])
def test_times_of_every_type_are_subtracted_without_overflow(poses, name):
    times = np.arange(K + 1)
    if name == "int8":
        times = 10 * times - 100  # no difference of ends fits
    expected = take_steps(poses, times.astype(float), None)
    np.testing.assert_array_equal(take_steps(poses, times.astype(name), None), expected)


@pytest.mark.parametrize("name", ["uint8", "uint64", "int32"])
def test_unsigned_times_that_run_back_are_seen_to(poses, name):
    times = np.arange(K + 1).astype(name)
    times[7] = 2
    assert take_steps(poses, times, None)[6] == -4
    assert take_steps(poses, jnp.asarray(times), None)[6] == -4
    with pytest.raises(ValueError, match="do not increase"):
        identify(poses, times=times)


def test_the_widest_integers_have_the_right_difference(poses):
    times = np.arange(K + 1)
    times[0], times[-1] = np.iinfo(np.int64).min, np.iinfo(np.int64).max
    assert take_steps(poses, times, None)[-1] == np.iinfo(np.int64).max - (K - 1.0)
    assert take_steps(poses, times, None)[0] == 2.0**63


WRONG = {
    "float16": np.float16,
    "bfloat16": ml_dtypes.bfloat16,
    "bool": bool,
    "complex128": complex,
    "<U32": str,
    "object": object,
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("argument", ["poses", "times", "dt"])
def test_types_that_are_no_numbers_or_too_coarse_are_refused_by_name(poses, name, argument):
    arguments = {"poses": poses, "dt": None, "times": None}
    values = {"poses": poses, "times": DT * np.arange(K + 1), "dt": np.full(K, DT)}
    arguments[argument] = values[argument].astype(WRONG[name])
    if argument == "poses":
        arguments["dt"] = DT
    with pytest.raises(ValueError, match=rf"{argument} must be .* not {name}"):
        identify(**arguments)


@pytest.mark.parametrize(
    ("rows", "value", "words"),
    [([7], np.nan, "NaN .* See row 7, counted"), ([3, 4, 9], 2.0, "rigid .* See rows 3-4, 9 ")],
)
def test_errors_name_the_rows_of_a_window(poses, rows, value, words):
    spoiled = np.array(poses)
    spoiled[rows] = value
    for find in (identify, rf.segment):
        with pytest.raises(ValueError, match=words):
            find(spoiled, dt=DT)
    times = DT * np.arange(K + 1)
    times[5] = times[4]
    with pytest.raises(ValueError, match=r"do not increase.* See row 5,"):
        identify(poses, times=times)


def test_something_else_than_an_array_gets_a_remedy():
    with pytest.raises(ValueError, match=r"give load_recording\(path\)\.poses"):
        identify("walk.csv", dt=DT)


def test_distant_positions_in_single_precision_are_pointed_out():
    distant = np.array(synthetic.simulate("spherical", jax.random.key(1), noise=1e-4).poses, float)
    distant[:, 0, 3] += 1e6
    with jax.enable_x64(False), pytest.warns(UserWarning, match="rounds positions to .* mm"):
        identify(distant, dt=DT)


def test_coarse_arrays_of_jax_are_refused(poses):
    with pytest.raises(ValueError, match="not float16"):
        identify(jnp.asarray(poses, jnp.float16))
    with pytest.raises(ValueError, match="not float16"):
        jax.eval_shape(lambda poses: identify(poses), jax.ShapeDtypeStruct((21, 4, 4), jnp.float16))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"times": np.arange(K + 1).astype("datetime64[s]")}, r"times - times\[0\]"),
        ({"dt": np.timedelta64(50, "ms")}, r"dt / np.timedelta64"),
        ({"dt": "0.1"}, "dt must be"),
        ({"times": [[0, 1], [2]]}, "times must be an array of numbers"),
        ({"dt": np.ma.masked_array(np.full(K, DT), mask=np.arange(K) == 2)}, "masked"),
        ({"dt": decimal.Decimal("0.1")}, "dt must be"),
        ({"bounds": np.inf}, "positive and at most 1e\\+06 m"),
        ({"bounds": 1e200}, "positive and at most 1e\\+06 m"),
        ({"bounds": np.nan}, "positive and at most 1e\\+06 m"),
        ({"bounds": "1"}, "bounds must be"),
        ({"bounds": True}, "bounds must be"),
        ({"bounds": (1.0, 2.0, 3.0)}, "bounds must be one length"),
        ({"scales": True}, "scales must be"),
        ({"scales": "fast"}, "scales must be"),
        ({"scales": [1, 3]}, "scales must be powers of two"),
        ({"scales": 2**40}, "an eighth of the window"),
        ({"scales": np.nan}, "scales must be"),
        ({"assume": 3}, "assume must be the name"),
        ({"assume": "wheel"}, "No constraint 'wheel'"),
        ({"norm": "0"}, "plain number"),
        ({"norm": None}, "plain number"),
        ({"norm": [0, 1]}, "plain number"),
        ({"norm": np.nan}, "exponent"),
        ({"thresholds": rf.Thresholds(angular="a")}, "thresholds must be"),
        ({"thresholds": rf.Thresholds(angular=[0.1, 0.2])}, "one number each"),  # type: ignore[arg-type]
        ({"solver": rf.BasinHopping}, "solver must be a search"),
        ({"key": 3}, "key must be one key"),
        ({"key": jnp.zeros(3)}, "key must be one key"),
        ({"dt": 1e-60}, "too large or too small"),
        ({"dt": 1e30}, "too large or too small"),
    ],
)
def test_options_of_a_wrong_type_or_size_are_refused_in_words(poses, options, words):
    with pytest.raises(ValueError, match=words):
        identify(poses, **options)


def test_scales_of_every_integer_type_are_samples(poses):
    for kind in (np.uint8, np.int8, np.uint16, np.int64):
        assert take_scales(kind(2), 51) == 2
    assert take_scales([4, 1, 4], 51) == 5


@pytest.mark.parametrize("length", [9, 16, 17, 21])
def test_every_scale_that_is_accepted_has_displacements(poses, length):
    for scale in (1, 2):
        if scale == 1 or length > 16:
            assert identify(poses[:length], scales=scale).name == "Revolute joint"
        else:
            with pytest.raises(ValueError, match="an eighth of the window"):
                identify(poses[:length], scales=scale)


@pytest.mark.parametrize("where", [1e155, -1e30, 1e10])
def test_a_pose_beyond_the_earth_fails_its_window_and_no_other(poses, where):
    batch = np.stack([poses, poses])
    batch[1, 4, 0, 3] = where
    found = identify(batch)
    assert [rf.Status(int(code)) for code in found.status_code] == [rf.Status.OK, rf.Status.OUT_OF_RANGE]
    same(found[0], identify(np.stack([poses, poses]))[0])
    with pytest.raises(ValueError, match="too large or too small"):
        identify(batch[1])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1e-200, 1e-30, 1e-6, 1e3, 1e7, 9e8])
def test_no_window_has_nan_under_a_good_status(poses, size, dtype):
    """Motion from the very small to the very large, at the shortest and longest steps."""
    batch = np.tile(poses, (6, 1, 1, 1))
    batch[:, :, :3, 3] *= size
    batch[3:, :, :3, :3] = np.eye(3)
    steps = np.tile(np.array([1e-9, DT, 1e6])[:, None], (2, K))
    found = identify(batch.astype(dtype), dt=steps.astype(dtype))
    good = np.asarray(found.status_code) < 10
    # NaN says that it is no screw, or no universal joint
    number = found.noise.position
    for leaf in jax.tree.leaves(replace(found, pitch=number, universal_axes=number)):
        if np.issubdtype(leaf.dtype, np.floating):
            assert np.all(np.isfinite(np.asarray(leaf)[good]))


def test_a_body_that_slides_without_turning_at_all_is_a_prismatic_joint(poses):
    """Every direction of the origin is free, and its curvature zero to the last digit."""
    slid = np.tile(np.eye(4), (K + 1, 1, 1))
    slid[:, :3, 3] = np.sin(np.linspace(0, 3, K + 1))[:, None] * [0.1, 0.2, -0.05]
    slid[:, :3, 3] = np.round(slid[:, :3, 3] + [0.4, 0, 0], 3)  # the identity would be lost tracking
    found = rf.identify(slid, dt=DT)
    assert found.status is rf.Status.OK
    assert found.name == "Prismatic joint"


def test_what_json_reads_is_no_array():
    with pytest.raises(ValueError, match="poses must be"):
        identify({"poses": 1})
    assert read_numbers("x", [1, 2.5]).dtype == np.float64


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"length": 5.5}, "whole number"),
        ({"length": "9"}, "whole number"),
        ({"length": 9, "dt": "0.1"}, "dt must be"),
        ({"length": 9, "dt": True}, "dt must be"),
        ({"length": 9, "dt": 1e-60}, "steps from 1e-09 to 1e\\+06 s"),
        ({"length": 9, "dt": 1e20}, "steps from 1e-09 to 1e\\+06 s"),
        ({"length": 9, "key": 0}, "key must be"),
        ({"length": 9, "bounds": np.inf}, "bounds must"),
    ],
)
def test_streams_refuse_options_at_once(options, words):
    with pytest.raises(ValueError, match=words):
        rf.OnlineIdentifier(**options)


@pytest.mark.parametrize("time", ["0.1", True, np.datetime64("2020-01-01"), [0.1], None])
def test_streams_refuse_times_that_are_no_numbers(poses, time):
    online = rf.OnlineIdentifier(9)
    with pytest.raises(ValueError, match="time"):
        online.push(poses[0], time)
    assert len(online) == 0


@pytest.mark.parametrize("kind", [np.float16, bool, str])
def test_streams_refuse_poses_that_are_no_numbers(kind):
    with pytest.raises(ValueError, match="pose must be"):
        rf.OnlineIdentifier(9, dt=0.1).push(np.eye(4).astype(kind))


def test_a_folder_of_results_is_not_begun_with_input_that_is_refused(poses, tmp_path):
    pytest.importorskip("pyarrow")
    for windows in (np.stack([poses]).astype(np.float16), 5, None, [[1, 2]]):
        with pytest.raises(ValueError, match=r"poses|windows"):
            rf.identify_many(windows, tmp_path / "out", dt=DT)
    assert not (tmp_path / "out").exists()


def test_a_gpu_takes_fewer_long_windows_at_a_time(monkeypatch):
    """Otherwise, nine windows of 10,000 poses were 16,384 windows of this length, 34 GB."""
    chunks = {"cpu": 32, "gpu": 16384}
    assert inputs._chunk_size(chunks, 10_000) == 32
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    sizes = [inputs._chunk_size(chunks, length) for length in (5, 64, 65, 128, 10_000, 2**30)]
    assert sizes == [16384, 16384, 8192, 8192, 64, 1]
