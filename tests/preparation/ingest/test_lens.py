from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.preparation.ingest.lens import capture_geometry
from sharpfield.preparation.ingest.options import Optics
from tests.streams import HEIGHT, WIDTH, random_events

SIZE = (WIDTH, HEIGHT)
RADTAN = "11.0 11.5 5.4 4.6 -0.2 0.05 0.001 -0.002 0.0"
KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [11.0, 11.5, 5.4, 4.6]
  resolution: [12, 10]
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [22.0, 23.0, 11.3, 9.7]
  resolution: [24, 20]
"""


@pytest.fixture
def radtan(tmp_path) -> Path:
    (tmp_path / "calib.txt").write_text(RADTAN)
    return tmp_path / "calib.txt"


@pytest.fixture
def kalibr(tmp_path) -> Path:
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    return tmp_path / "camchain.yaml"


def image(width: int, height: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width] / height
    return np.rint(120 + 60 * np.sin(3 * x) + 50 * y).astype(np.uint8)


def test_without_a_calibration_the_lens_is_unknown():
    found = capture_geometry(SIZE, SIZE, Optics(), "cam.raw")
    assert found.camera.fx_px == WIDTH
    assert found.intrinsics == "unknown"
    np.testing.assert_array_equal(found.mapped_image(image(*SIZE), "")[..., 0], image(*SIZE))


def test_a_lens_is_told_and_nothing_is_resampled(radtan):
    found = capture_geometry(SIZE, SIZE, Optics(calibration=radtan), "cam.raw")
    assert found.camera.lens == "brown"
    assert found.camera.cx_px == 5.9, "pixels count from the corner here"
    events = random_events(100)
    assert found.mapped_events(events, "").x is events.x
    np.testing.assert_array_equal(found.mapped_image(image(*SIZE), "")[..., 0], image(*SIZE))


def test_rectified_frames_and_events_are_those_of_opencv(radtan):
    found = capture_geometry(SIZE, SIZE, Optics(calibration=radtan, rectify=True), "cam.raw")
    assert (found.camera.lens, found.camera.distortion) == ("pinhole", ())
    matrix = np.array([[11.0, 0, 5.4], [0, 11.5, 4.6], [0, 0, 1]])
    lens = np.array([-0.2, 0.05, 0.001, -0.002, 0.0])
    events = random_events(300)
    pixels = np.stack([events.x, events.y], -1).astype(np.float64)[:, None]
    ideal = cv2.undistortPoints(pixels, matrix, lens, P=matrix)[:, 0]
    mapped_events = found.mapped_events(events, "")
    assert mapped_events.rectified
    # OpenCV stops after a few steps of its iteration, hence the tolerance.
    np.testing.assert_allclose(np.stack([mapped_events.x, mapped_events.y], -1), ideal, atol=2e-3)
    wanted = cv2.undistort(image(*SIZE), matrix, lens)
    np.testing.assert_allclose(found.mapped_image(image(*SIZE), "")[..., 0], wanted, atol=1)


def test_rectified_events_keep_their_colours(radtan):
    found = capture_geometry(SIZE, None, Optics(calibration=radtan, rectify=True), "cam.raw")
    colours = found.mapped_events(random_events(10), "RGGB").site_colour
    assert colours is not None
    tile = colours.channel.reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(tile[:2, :2], [[0, 1], [1, 2]])
    np.testing.assert_array_equal(tile[2:4, 4:6], [[0, 1], [1, 2]])


def test_raw_colour_becomes_rgb():
    red = np.zeros((HEIGHT, WIDTH), np.uint8)
    red[::2, ::2] = 200  # where the filter of RGGB is red
    found = capture_geometry(SIZE, SIZE, Optics(), "cam.raw").mapped_image(red, "RGGB")
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert found[4, 4].tolist() == [200, 0, 0]


def test_frames_of_a_camera_beside_are_seen_from_the_events(kalibr):
    optics = Optics(calibration=kalibr, camera="cam0", frame_camera="cam1")
    found = capture_geometry(SIZE, (24, 20), optics, "cam.raw")
    assert found.separate_sensors
    assert found.notes["frame_camera_distance"] == pytest.approx(0.1)
    assert found.frame_map is not None
    # A far point that the event camera sees at a pixel, and where the other camera has it.
    direction = found.camera.direction(found.camera.grid().double())[3, 7]
    plane = (direction[:2] / direction[2]).numpy()
    np.testing.assert_allclose(found.frame_map[3, 7], plane * [22.0, 23.0] + [11.3, 9.7], atol=1e-4)
    assert found.mapped_image(image(24, 20), "").shape == (HEIGHT, WIDTH, 1)


# What does not fit


def test_what_cannot_be_known(kalibr, radtan):
    with pytest.raises(CaptureError, match="several cameras") as caught:
        capture_geometry(SIZE, None, Optics(calibration=kalibr), "cam.raw")
    assert "cam0, cam1" in str(caught.value)
    with pytest.raises(CaptureError, match="another image size"):
        capture_geometry(SIZE, None, Optics(calibration=kalibr, camera="cam1"), "cam.raw")
    with pytest.raises(OptionError, match="lenses are not known"):
        capture_geometry(SIZE, None, Optics(rectify=True), "cam.raw")
    with pytest.raises(CaptureError, match="different sizes"):
        capture_geometry(SIZE, (24, 20), Optics(calibration=radtan), "cam.raw")
    alone = replace(Optics(calibration=kalibr, camera="cam0"), frame_camera="cam1")
    kalibr.write_text(KALIBR.replace("T_cn_cnm1", "T_other"))
    with pytest.raises(CaptureError, match="relative pose of the two cameras"):
        capture_geometry(SIZE, (24, 20), alone, "cam.raw")
