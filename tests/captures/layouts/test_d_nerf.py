import json
from pathlib import Path

import numpy as np
import pytest

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.read import layout_of, read_capture
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image

IDENTITY = np.eye(4).tolist()


def scene(folder: Path, *, times: bool = True) -> Path:
    """Four frames to learn from and two to test, 6x5, half transparent."""
    draw = np.random.default_rng(0)
    for name, count in (("train", 4), ("test", 2), ("val", 3)):
        frames = []
        for i in range(count):
            matrix = np.eye(4)
            matrix[:3, 3] = [i, len(name), 4]
            frame = {"file_path": f"./{name}/r_{i:03d}", "transform_matrix": matrix.tolist()}
            frames.append(frame | ({"time": i / (count - 1)} if times else {}))
            image = draw.integers(0, 256, (5, 6, 4), dtype=np.uint8)
            image[0, 0] = (10, 20, 30, 0)
            write_image(folder / name / f"r_{i:03d}.png", image)
        about = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(about))
    return folder


def test_a_scene(tmp_path: Path) -> None:
    found = read_capture(scene(tmp_path))
    assert found.source == "d-nerf" and (found.near, found.far) == (2.0, 6.0)
    frames = found.needed_frames
    np.testing.assert_array_equal(
        frames.exposure.open_us, [0, 333_333, 666_667, 1_000_000, 0, 1_000_000]
    )
    np.testing.assert_array_equal(frames.track, np.arange(6))
    assert frames.exposure.instant.all() and frames.names[4] == "test/r_000"
    np.testing.assert_array_equal(found.split.train, [0, 1, 2, 3])
    np.testing.assert_array_equal(found.split.test, [4, 5])
    np.testing.assert_array_equal(frames.images[:, 0, 0], 255)  # on white
    assert found.camera.fx_px == pytest.approx(3 / np.tan(0.35))
    np.testing.assert_allclose(found.frame_pose(np.array([2]))[0, :, 3], [2, 5, 4])
    assert found.frame_time[2].tolist() == pytest.approx([0.666667] * 2)


def test_times_tell_it_from_a_scene_that_stands_still(tmp_path: Path) -> None:
    assert layout_of(scene(tmp_path / "moving")) == "d-nerf"
    assert layout_of(scene(tmp_path / "still", times=False)) == "nerf-synthetic"


def test_a_damaged_file_is_left_to_the_reader_that_says_so(tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text("{")
    with pytest.raises(CaptureError, match="not a JSON file"):
        read_capture(tmp_path)


def test_missing_images_may_be_skipped(tmp_path: Path) -> None:
    scene(tmp_path)
    (tmp_path / "train" / "r_001.png").unlink()
    with pytest.raises(CaptureError, match="1 of 4 images are missing"):
        read_capture(tmp_path)
    found = read_capture(tmp_path, ReadOptions(missing="skip"))
    assert found.needed_frames.names[1] == "train/r_002" and len(found.split.train) == 3


def test_sets_of_different_cameras_are_refused(tmp_path: Path) -> None:
    path = scene(tmp_path) / "transforms_test.json"
    path.write_text(path.read_text().replace("0.7", "0.8"))
    with pytest.raises(CaptureError, match="must share one camera"):
        read_capture(tmp_path)
