import json
import math
import re

import numpy as np
import pytest

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.layouts import blender
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image

ANGLE = 2 * math.atan(0.5)  # the focal length equals the width


def written(folder, **sets):
    """A scene with so many frames in each set; frame i stands at (0, 0, i), looking down -z."""
    for name, count in sets.items():
        frames = []
        for i in range(count):
            matrix = np.eye(4)
            matrix[2, 3] = i
            frames.append({"file_path": f"./{name}/r_{i}", "transform_matrix": matrix.tolist()})
            image = np.full((6, 8, 4), [10, 20, 30, 0 if i == 0 else 255], np.uint8)
            write_image(folder / name / f"r_{i}.png", image)
        content = {"camera_angle_x": ANGLE, "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(content))


def changed(folder, **keys):
    path = folder / "transforms_train.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **keys}))


def test_axes_camera_and_background(tmp_path):
    written(tmp_path, train=3, test=2)
    capture = blender.read(tmp_path)
    pose = capture.frame_pose(np.array([2]))[0]
    np.testing.assert_array_equal(pose, [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2]])
    assert capture.camera.fx_px == pytest.approx(8)
    assert (capture.camera.cx_px, capture.camera.cy_px) == (4, 3)
    assert (capture.frames.images[0] == 255).all()  # transparent on white
    assert (capture.frames.images[1] == [10, 20, 30]).all()
    assert capture.frames.names == ("train/r_0", "train/r_1", "train/r_2", "test/r_0", "test/r_1")


@pytest.mark.parametrize(
    ("sets", "train", "test"),
    [
        ({"train": 3, "val": 4, "test": 2}, [0, 1, 2], [3, 4]),
        ({"train": 2, "val": 1}, [0, 1], [2]),
        ({"train": 9}, [1, 2, 3, 4, 5, 6, 7], [0, 8]),
    ],
)
def test_what_is_held_out(tmp_path, sets, train, test):
    written(tmp_path, **sets)
    split = blender.read(tmp_path).split
    assert (split.train.tolist(), split.test.tolist()) == (train, test)


def test_missing_images_are_told_or_skipped(tmp_path):
    written(tmp_path, train=12)
    for i in (1, 3, 5, 7):
        (tmp_path / "train" / f"r_{i}.png").unlink()
    with pytest.raises(CaptureError) as told:
        blender.read(tmp_path)
    assert str(told.value) == (
        "CaptureError: 4 of 12 images are missing\n"
        f"  where  {tmp_path}/transforms_train.json\n"
        f"  got    no r_1.png, r_3.png, r_5.png, ... in {tmp_path}/train\n"
        "  do     complete the download, or set the option `missing` to skip"
    )
    capture = blender.read(tmp_path, ReadOptions(missing="skip"))
    assert capture.frames.names[:3] == ("train/r_0", "train/r_2", "train/r_4")
    assert capture.trajectory.poses[:3, 2, 3].tolist() == [0, 2, 4]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"camera_angle_x": None}, "`camera_angle_x` must be a number"),
        ({"camera_angle_x": 4.0}, "between 0 and pi"),
        ({"frames": []}, "there are no frames"),
        ({"frames": [{"file_path": "train/r_0"}]}, "frame lacks `transform_matrix`"),
        (
            {"frames": [{"file_path": "train/r_0", "transform_matrix": [[1, 0], [0, 1]]}]},
            "must be 4x4 or 3x4 numbers",
        ),
        (
            {"frames": [{"file_path": "train/r_0", "transform_matrix": (2 * np.eye(4)).tolist()}]},
            "not orthonormal",
        ),
    ],
)
def test_bad_files_are_refused(tmp_path, keys, message):
    written(tmp_path, train=2)
    changed(tmp_path, **keys)
    with pytest.raises(CaptureError, match=re.escape(message)):
        blender.read(tmp_path)


def test_what_is_no_json_is_refused(tmp_path):
    (tmp_path / "transforms_train.json").write_text("{")
    with pytest.raises(CaptureError, match="not a JSON file"):
        blender.read(tmp_path)


def test_a_published_scene(samples, tmp_path):
    """All cameras look at the object from a distance of 4.03; 50 of the 100 images are there."""
    lego = samples / "posed" / "nerf_synthetic_lego"
    assert blender.recognise(lego)
    with pytest.raises(CaptureError, match="50 of 100 images are missing"):
        blender.read(lego)
    # Four images suffice here: reading all of them takes seconds.
    content = json.loads((lego / "transforms_train.json").read_text())
    content["frames"] = content["frames"][:8]
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    (tmp_path / "train").symlink_to(lego / "train")
    capture = blender.read(tmp_path, ReadOptions(missing="skip"))
    assert capture.frames.images.shape == (4, 800, 800, 3)
    assert capture.camera.fx_px == pytest.approx(1111.1110, abs=1e-3)
    towards = -(capture.trajectory.poses[:, :, 3] * capture.trajectory.poses[:, :, 2]).sum(-1)
    np.testing.assert_allclose(towards, 4.0311, atol=1e-3)
