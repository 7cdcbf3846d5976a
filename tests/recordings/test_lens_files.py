from pathlib import Path

import cv2
import numpy as np
import pytest

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError
from sharpfield.recordings.lens_files import read_calibration, resampling_map, undistorted_pixels

SIZE = (240, 180)
MATRIX = np.array([[335.5, 0.0, 129.9], [0.0, 335.25, 99.125], [0.0, 0.0, 1.0]])
BROWN = [-0.125, 0.09375, -0.0005, 0.00025, 0.0]
LENS = Camera(240, 180, 335.5, 335.25, 130.4, 99.625, "brown", tuple(BROWN))

DSEC = """
extrinsics:
  R_rect0: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
  T_10:
  - [0.0, -1.0, 0.0, 0.5]
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
intrinsics:
  cam0:
    camera_matrix: [335.5, 335.25, 129.9, 99.125]
    distortion_coeffs: [-0.125, 0.09375, -0.0005, 0.00025]
    distortion_model: plumb_bob
    resolution: [240, 180]
  cam1:
    camera_matrix: [1150.0, 1151.0, 700.0, 500.0]
    distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
    distortion_model: plumb_bob
    resolution: [1440, 1080]
  camRect0:
    camera_matrix: [550.0, 550.0, 120.0, 90.0]
    resolution: [240, 180]
"""

ROS = """
image_width: 240
image_height: 180
camera_name: dvs
camera_matrix:
  rows: 3
  cols: 3
  data: [335.5, 0, 129.9, 0, 335.25, 99.125, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.125, 0.09375, -0.0005, 0.00025, 0]
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def opencv(path: Path) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 240)
    file.write("image_height", 180)
    file.write("camera_matrix", MATRIX)
    file.write("distortion_coefficients", np.array(BROWN)[:, None])
    file.release()
    return path


def only(path: Path, **options) -> Camera:
    return read_calibration(path, **options).camera(None, path)[1]


def test_every_program_tells_the_same_lens(tmp_path):
    rpg = " ".join(map(str, [335.5, 335.25, 129.9, 99.125, *BROWN]))
    assert only(written(tmp_path / "calib.txt", rpg), size=SIZE) == LENS
    assert only(opencv(tmp_path / "c.yml")) == LENS
    assert only(opencv(tmp_path / "c.xml")) == LENS
    assert only(written(tmp_path / "ros.yaml", ROS)) == LENS
    dsec = read_calibration(written(tmp_path / "cam_to_cam.yaml", DSEC))
    assert dsec.cameras["cam0"] == LENS
    assert list(dsec.cameras) == ["cam0", "cam1", "camRect0"]


def test_how_cameras_stand_to_each_other(tmp_path):
    found = read_calibration(written(tmp_path / "cam_to_cam.yaml", DSEC))
    there, back = found.other_from_camera("cam0", "cam1"), found.other_from_camera("cam1", "cam0")
    assert there is not None and back is not None
    np.testing.assert_allclose(there @ [1, 2, 3, 1], [-1.5, 1, 3, 1])
    np.testing.assert_allclose(back @ there, np.eye(4), atol=1e-12)
    assert found.other_from_camera("cam0", "camRect0") is None


def test_a_fisheye(tmp_path):
    text = DSEC.replace("plumb_bob", "equidistant")
    found = read_calibration(written(tmp_path / "c.yaml", text)).cameras["cam0"]
    assert (found.lens, found.distortion) == ("fisheye", (-0.125, 0.09375, -0.0005, 0.00025))


# Maps are those of OpenCV


def grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(240.0), np.arange(180.0)), -1)


def test_undistorted_pixels_are_those_of_opencv():
    wanted = cv2.undistortPoints(
        grid().reshape(-1, 1, 2), MATRIX, np.array(BROWN), P=MATRIX
    ).reshape(180, 240, 2)
    np.testing.assert_allclose(undistorted_pixels(LENS), wanted, atol=1e-3)


def test_where_undistorted_pixels_lie_is_what_opencv_says():
    ideal = Camera(240, 180, 335.5, 335.25, 130.4, 99.625)
    across, down = cv2.initUndistortRectifyMap(
        MATRIX, np.array(BROWN), None, MATRIX, SIZE, cv2.CV_32FC1
    )
    np.testing.assert_allclose(resampling_map(ideal, LENS), np.stack([across, down], -1), atol=1e-3)


def test_a_turned_camera_sees_far_points_elsewhere():
    ideal = Camera(240, 180, 335.5, 335.25, 130.4, 99.625)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = resampling_map(ideal, ideal, turn)
    np.testing.assert_allclose(
        found[99, 140],
        [129.9 - 335.5 * (99.5 - 99.625) / 335.25, 99.125 + 335.25 * 10.1 / 335.5],
        atol=1e-2,
    )
    behind = resampling_map(ideal, ideal, np.diag([1.0, -1, -1]))
    assert (behind < -1000).all(), "what lies behind is not in the image"


# What cannot be read


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fx: 3", "no calibration of a known kind"),
        (DSEC.replace("plumb_bob", "double_sphere"), "unknown lens model"),
        (DSEC.replace("[335.5, 335.25, 129.9, 99.125]", "[1, 2, 3]"), "unknown camera model"),
        (DSEC.replace("[335.5, 335.25", "[.nan, 335.25"), "must be a list of numbers"),
        (DSEC.replace("- [0.0, -1.0, 0.0, 0.5]", "- [3.0, -1.0, 0.0, 0.5]"), "not a rigid motion"),
        (ROS.replace("99.125, 0, 0, 1]", "99.125]"), "nine numbers"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, message):
    with pytest.raises(CaptureError, match=message) as caught:
        calibration = read_calibration(written(tmp_path / "c.yaml", text))
        calibration.camera("cam0", "c.yaml")
    assert "c.yaml" in str(caught.value)


def test_what_is_not_there_is_said(tmp_path):
    with pytest.raises(CaptureError, match="calibration not found"):
        read_calibration(tmp_path / "none.yaml")
    with pytest.raises(CaptureError, match="image size"):
        only(written(tmp_path / "calib.txt", "1 1 0 0 0 0 0 0 0"))
    (tmp_path / "c.xml").write_bytes(b"<?xml version='1.0'?><opencv_storage><a>")
    with pytest.raises(CaptureError):
        only(tmp_path / "c.xml")


def test_the_sample_of_rpg(samples):
    camera = only(samples / "slider_depth_noevents" / "calib.txt", size=SIZE)
    assert (camera.lens, camera.fx_px) == ("brown", 335.419462958)
