"""Every status from a window made to have it, and only in that window."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from reframe_jax.geometry import transforms
from reframe_jax.motion.checks import MIN_VELOCITIES, Status, window_status

STEPS = 6
DT = np.full(STEPS, 0.05)
status_of = jax.jit(window_status)


@pytest.fixture
def poses(rng):
    return np.array(transforms.pose_exp(jnp.asarray(rng.normal(size=(STEPS + 1, 6)))))


def nan_pose(poses, dt):
    poses[2, 1, 3] = np.nan


def infinite_pose(poses, dt):
    poses[0, 0, 0] = np.inf


def nan_time(poses, dt):
    dt[3] = np.nan


def nan_bottom_row(poses, dt):
    poses[-1, 3, 3] = np.nan


def scaled_rotation(poses, dt):
    poses[4, :3, :3] *= 1.01


def skewed_rotation(poses, dt):
    poses[0, :3, :3] = poses[0, :3, :3] @ (np.eye(3) + 0.01 * np.eye(3, k=1))


def mirrored(poses, dt):
    poses[:, :3, 0] *= -1


def no_rotation(poses, dt):
    poses[1, :3, :3] = 0


def transposed(poses, dt):
    poses[:] = np.swapaxes(poses, 1, 2)


def scaled_bottom_row(poses, dt):
    poses[3, 3, 3] = 2


def standing_time(poses, dt):
    dt[5] = 0


def time_running_back(poses, dt):
    dt[0] = -0.05


def still(poses, dt):
    poses[:] = poses[0]


BROKEN = {
    nan_pose: Status.NOT_FINITE,
    infinite_pose: Status.NOT_FINITE,
    nan_time: Status.NOT_FINITE,
    nan_bottom_row: Status.NOT_FINITE,
    scaled_rotation: Status.NOT_A_POSE,
    skewed_rotation: Status.NOT_A_POSE,
    mirrored: Status.NOT_A_POSE,
    no_rotation: Status.NOT_A_POSE,
    transposed: Status.NOT_A_POSE,
    scaled_bottom_row: Status.NOT_A_POSE,
    standing_time: Status.TIMES_NOT_INCREASING,
    time_running_back: Status.TIMES_NOT_INCREASING,
    still: Status.NO_MOTION,
}


def broken(breaking, poses):
    poses, dt = poses.copy(), DT.copy()
    breaking(poses, dt)
    return poses, dt


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_good_window(dtype, poses):
    status = status_of(poses.astype(dtype), DT.astype(dtype))
    assert status.dtype == jnp.int32
    assert Status(int(status)) is Status.OK


@pytest.mark.parametrize("breaking", BROKEN)
def test_each_code(breaking, poses):
    assert Status(int(status_of(*broken(breaking, poses)))) is BROKEN[breaking]


def test_rounding_is_forgiven(poses):
    """Matrices printed with four digits are still poses."""
    assert status_of(np.round(poses, 4), DT) == Status.OK


def test_smallest_motion_counts(poses):
    poses[:] = poses[0]
    poses[3, 0, 3] += 1e-12
    assert status_of(poses, DT) == Status.OK


@pytest.mark.parametrize("second", [nan_pose, scaled_rotation, standing_time])
def test_the_first_of_several_faults_is_named(second, poses):
    """In the order of the codes."""
    poses, dt = broken(still, poses)
    second(poses, dt)
    standing_time(poses, dt)
    assert status_of(poses, dt) == BROKEN[second]


def test_windows_are_judged_alone(poses):
    """A batch of all faults beside good windows, with one sample time for all and with their own."""
    windows = [broken(breaking, poses) for breaking in BROKEN]
    expected = [code for code in BROKEN.values()]
    batch = np.stack([w for window, _ in windows for w in (poses, window)])
    steps = np.stack([w for _, dt in windows for w in (DT, dt)])
    found = np.asarray(status_of(batch, steps))
    np.testing.assert_array_equal(found[0::2], Status.OK)
    np.testing.assert_array_equal(found[1::2], expected)
    folded = status_of(batch.reshape(2, -1, *batch.shape[1:]), steps.reshape(2, -1, STEPS))
    np.testing.assert_array_equal(folded, found.reshape(2, -1))
    timed = [code in (Status.TIMES_NOT_INCREASING,) or b is nan_time for b, code in BROKEN.items()]
    shared = np.asarray(status_of(batch, DT))
    np.testing.assert_array_equal(shared[1::2], np.where(timed, Status.OK, expected))


def test_messages():
    assert Status(int(Status.OK)) is Status.OK
    for status in Status:
        assert status.message.endswith(".")
        assert status.failed == (status >= Status.NOT_FINITE)
    assert not Status.ON_BOUNDS.failed
    assert not Status.NOT_EXCITED.failed
    assert len({status.message for status in Status}) == len(Status)


def test_fewest_velocities(rng):
    """Three velocities can always be made coplanar by a choice of origin, four cannot."""
    assert MIN_VELOCITIES == 4
    line = np.linspace(-1e3, 1e3, 2001)[:, None] * np.array([1.0, 0.3, -0.2])
    for window in rng.normal(size=(20, 4, 3, 4)):
        u = window[None, ..., 0] + np.einsum("kij,pj->pki", window[..., 1:], line)
        determinants = np.linalg.det(u[:, :3])
        assert np.min(determinants) < 0 < np.max(determinants)
        assert np.min(np.linalg.svd(u, compute_uv=False)[:, -1]) > 1e-3
