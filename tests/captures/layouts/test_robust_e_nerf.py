import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sharpfield.captures.read import layout_of, read_capture
from sharpfield.core.capture import Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image

WIDTH, HEIGHT, POSES, COUNT = 16, 12, 6, 300
FIRST_NS = 3_000_000_000


def calibration(**change: object) -> dict:
    return {
        "intrinsics": np.array([[20, 0, 7.5], [0, 21, 5.5], [0, 0, 1]], np.float32),
        "distortion_params": np.array([], np.float32),
        "distortion_model": np.array(""),
        "img_height": np.array(HEIGHT, np.uint16),
        "img_width": np.array(WIDTH, np.uint16),
        "pos_contrast_threshold": np.array(0.25, np.float32),
        "neg_contrast_threshold": np.array(0.5, np.float32),
        "refractory_period": np.array(8000),
        "bayer_pattern": np.array("RGGB"),
        **change,
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    draw = np.random.default_rng(0)
    out = tmp_path / "scene"
    out.mkdir()
    np.savez(
        out / "raw_events.npz",
        position=np.stack(
            [draw.integers(0, WIDTH, COUNT), draw.integers(0, HEIGHT, COUNT)], -1
        ).astype(np.uint16),
        timestamp=FIRST_NS + np.sort(draw.integers(0, 500_000_000, COUNT)),
        polarity=draw.random(COUNT) < 0.5,
    )
    np.savez(
        out / "camera_poses.npz",
        T_wc_position=np.arange(POSES)[:, None] * np.array([0.1, 0, 0]) + [0, 0, -3],
        T_wc_orientation=rotations().as_quat().astype(np.float32),  # x y z w
        T_wc_timestamp=FIRST_NS + np.arange(POSES) * 100_000_000,
    )
    np.savez(out / "camera_calibration.npz", **calibration())
    return out


def rotations() -> Rotation:
    return Rotation.from_rotvec(np.arange(POSES)[:, None] * np.array([0.05, -0.02, 0.03]))


def views(folder: Path, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    matrix = np.diag([1.0, -1, -1, 1])
    matrix[2, 3] = -3
    frames = [{"file_path": "./test/r_0", "transform_matrix": matrix.tolist()}]
    (folder / "views" / "test").mkdir(parents=True)
    about = {"camera_angle_x": 0.7, "frames": frames}
    (folder / "views" / "transforms_test.json").write_text(json.dumps(about))
    write_image(folder / "views" / "test" / "r_0.png", np.zeros((*size, 3), np.uint8))


def test_a_scene(folder: Path) -> None:
    found = read_capture(folder)
    assert layout_of(folder) == found.source == "robust-e-nerf"
    camera = found.camera
    assert (camera.width, camera.height, camera.lens) == (WIDTH, HEIGHT, "pinhole")
    assert (camera.fx_px, camera.cx_px, camera.cy_px) == (20, 8.0, 6.0)  # centres at +0.5
    assert found.clock.origin_us == 3_000_000 and found.clock.span_us == 500_000
    time, track = torch.tensor([0.2, 0.3]), torch.zeros(2, dtype=torch.int64)
    poses = found.trajectory.pose(time, track).double().numpy()
    np.testing.assert_allclose(poses[0][:, :3], rotations()[1].as_matrix(), atol=1e-6)
    np.testing.assert_allclose(poses[:, 0, 3], [0.1, 0.15], atol=1e-6)
    events = found.needed_events
    assert len(events) == COUNT and events.bayer == "RGGB" and set(events.p) == {-1, 1}
    assert found.known.thresholds == Thresholds(0.5, 0.25)
    assert found.known.refractory_us == 8.0
    assert found.frames is None


@pytest.mark.parametrize("beside", [False, True])
def test_images_to_be_predicted(folder: Path, beside: bool) -> None:
    views(folder.parent if beside else folder)
    found = read_capture(folder)
    assert found.split.test.tolist() == [0] and len(found.split.train) == 0
    expected = np.eye(4)[:3]
    expected[2, 3] = -3
    np.testing.assert_allclose(found.frame_pose(np.array([0]))[0], expected, atol=1e-6)


def test_images_of_another_camera_are_left_out(folder: Path) -> None:
    views(folder, (HEIGHT, WIDTH + 1))
    found = read_capture(folder)
    assert found.frames is None and "another size" in found.notes["views"]


def test_a_real_cameras_thresholds_are_not_known(folder: Path) -> None:
    change = {"pos_contrast_threshold": np.array(np.nan)}
    np.savez(folder / "camera_calibration.npz", **calibration(**change))
    assert read_capture(folder).known.thresholds is None


@pytest.mark.parametrize(
    ("model", "lens", "count"), [("plumb_bob", "brown", 5), ("equidistant", "fisheye", 4)]
)
def test_lenses(folder: Path, model: str, lens: str, count: int) -> None:
    bent = np.array([-0.1, 0.02, 0.001, 0.002])
    change = {"distortion_params": bent, "distortion_model": np.array(model)}
    np.savez(folder / "camera_calibration.npz", **calibration(**change))
    camera = read_capture(folder).camera
    assert camera.lens == lens and len(camera.distortion) == count
    assert camera.distortion[:4] == pytest.approx(bent)


def test_what_is_not_supported_or_missing_is_told(folder: Path) -> None:
    change = {"distortion_params": np.ones(4), "distortion_model": np.array("fov")}
    np.savez(folder / "camera_calibration.npz", **calibration(**change))
    with pytest.raises(CaptureError, match="distortion model is not supported"):
        read_capture(folder)
    np.savez(folder / "camera_calibration.npz", intrinsics=np.eye(3))
    with pytest.raises(CaptureError, match="array img_height is missing"):
        read_capture(folder)
