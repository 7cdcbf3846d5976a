import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sharpfield.captures.native.trajectory import write_trajectory
from sharpfield.captures.trajectory_files import read_poses
from sharpfield.core.capture import Clock
from sharpfield.core.errors import CaptureError
from sharpfield.geometry.trajectory import Stamped, Tracks
from tests.conftest import turning

TIMES = np.arange(0, 90_000, 9_000)


def tum(poses: np.ndarray) -> str:
    turned = Rotation.from_matrix(poses[:, :, :3]).as_quat()  # x y z w
    rows = np.column_stack([TIMES * 1e-6, poses[:, :, 3], turned])
    return "# t x y z qx qy qz qw\n" + "\n".join(" ".join(f"{v:.9f}" for v in r) for r in rows)


def test_a_tum_text_is_read(tmp_path):
    poses = turning(TIMES)
    (tmp_path / "path.txt").write_text(tum(poses))
    times, found = read_poses(tmp_path / "path.txt")
    np.testing.assert_array_equal(times, TIMES)
    np.testing.assert_allclose(found, poses, atol=1e-8)


@pytest.mark.parametrize("rig", [False, True])
def test_our_own_file_is_read(tmp_path, rig):
    path = Stamped(TIMES, turning(TIMES), Clock(0, 90_000))
    write_trajectory(Tracks([path], np.zeros((0, 3, 4))) if rig else path, tmp_path)
    times, found = read_poses(tmp_path / "trajectory.npz")
    np.testing.assert_array_equal(times, TIMES)
    np.testing.assert_array_equal(found, path.poses)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot read the trajectory"),
        ("0 0 0 0 0 0 0 1 5\n", "9 columns"),
        ("0 0 0 0 0 0 zero 1\n", "cannot read the trajectory"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 3\n", "pose 1"),
        ("0 nan 0 0 0 0 0 1\n", "NaN"),
    ],
)
def test_other_texts_are_refused(tmp_path, text, message):
    (tmp_path / "path.txt").write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_poses(tmp_path / "path.txt")


def test_what_is_no_path_is_refused(tmp_path):
    np.savez(tmp_path / "still.npz", poses=turning(TIMES))
    with pytest.raises(CaptureError, match="holds no trajectory with times"):
        read_poses(tmp_path / "still.npz")
    with pytest.raises(CaptureError, match="not found"):
        read_poses(tmp_path / "nowhere.txt")
