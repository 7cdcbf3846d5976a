import json
import math
import re

import numpy as np
import pytest

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.layouts import nerfstudio
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image
from sharpfield.storage.ply import Ply, write_ply

INTRINSICS = {"fl_x": 10.0, "fl_y": 11.0, "cx": 4.5, "cy": 3.5, "w": 8, "h": 6}


def looking_at_origin(angle, distance=5.0):
    """OpenGL camera-to-world on a circle in the plane y = 0."""
    backward = np.array([math.sin(angle), 0, math.cos(angle)])
    up = np.array([0.0, 1, 0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([np.cross(up, backward), up, backward, distance * backward], -1)
    return matrix


def written(folder, count=9, frame_keys=(), **keys):
    frames = []
    for i in range(count):
        name = f"images/frame_{i:05d}.jpg"
        write_image(folder / name, np.full((6, 8, 3), i, np.uint8))
        extra = frame_keys[i] if frame_keys else {}
        pose = looking_at_origin(0.3 * i).tolist()
        frames.insert(0, {"file_path": name, "transform_matrix": pose, **extra})
    content = {**INTRINSICS, "frames": frames, **keys}
    (folder / "transforms.json").write_text(json.dumps(content))


def test_a_pinhole_scene(tmp_path):
    written(tmp_path)
    capture = nerfstudio.read(tmp_path)
    camera = capture.camera
    assert camera.lens == "pinhole"
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (10.0, 11.0, 4.5, 3.5)
    assert capture.frames.names[1] == "images/frame_00001"  # sorted by name
    np.testing.assert_allclose(capture.frames.images[:, 0, 0, 0], np.arange(9), atol=2)
    forward = capture.trajectory.poses[3, :, 2]
    np.testing.assert_allclose(forward, [-math.sin(0.9), 0, -math.cos(0.9)], atol=1e-9)
    assert capture.split.test.tolist() == [0, 8]


@pytest.mark.parametrize(
    ("keys", "lens", "distortion"),
    [
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "brown", (0.1, 0.2, 0.3, 0.4, 0.0)),
        ({"camera_model": "OPENCV", "k3": 0.5}, "brown", (0, 0, 0, 0, 0.5)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "fisheye", (0.1, 0, 0, 0.4)),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "pinhole", ()),
    ],
)
def test_lenses(tmp_path, keys, lens, distortion):
    written(tmp_path, **keys)
    camera = nerfstudio.read(tmp_path).camera
    assert (camera.lens, camera.distortion) == (lens, distortion)


def test_named_sets(tmp_path):
    names = [f"images/frame_{i:05d}.jpg" for i in range(9)]
    written(tmp_path, train_filenames=names[:5], val_filenames=names[5:6], test_filenames=names[6:])
    split = nerfstudio.read(tmp_path).split
    assert split.train.tolist() == [0, 1, 2, 3, 4]
    assert split.test.tolist() == [6, 7, 8]


def test_bounds_are_guessed_from_what_the_cameras_look_at(tmp_path):
    written(tmp_path)
    capture = nerfstudio.read(tmp_path)
    assert (capture.near, capture.far) == pytest.approx((0.5, 50))
    assert capture.known.bounds == "estimated"
    told = nerfstudio.read(tmp_path, ReadOptions(bounds=(1.0, 7.0)))
    assert (told.near, told.far) == (1, 7)
    assert told.known.bounds == "known"


def test_parallel_cameras_look_at_no_point():
    poses = np.tile(np.eye(3, 4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    assert nerfstudio.estimated_bounds(poses) == pytest.approx((2.0, 200.0))
    assert nerfstudio.estimated_bounds(poses[:1]) == pytest.approx((1.0, 100.0))


def test_points(tmp_path):
    written(tmp_path, ply_file_path="sparse_pc.ply")
    rows = np.array([(1, 2, 3, 9), (4, 5, 6, 9)], [*((k, "f4") for k in "xyz"), ("red", "u1")])
    write_ply(tmp_path / "sparse_pc.ply", Ply(rows))
    np.testing.assert_array_equal(nerfstudio.read(tmp_path).points, [[1, 2, 3], [4, 5, 6]])
    write_ply(tmp_path / "sparse_pc.ply", Ply(rows[:0]))
    assert nerfstudio.read(tmp_path).points is None


def test_points_that_are_named_must_be_there(tmp_path):
    written(tmp_path, ply_file_path="sparse_pc.ply")
    with pytest.raises(CaptureError, match="file not found\n  where  .*sparse_pc.ply"):
        nerfstudio.read(tmp_path)
    written(tmp_path, ply_file_path=7)
    with pytest.raises(CaptureError, match="`ply_file_path` must be text"):
        nerfstudio.read(tmp_path)


def test_intrinsics_of_frames_may_be_given_one_by_one(tmp_path):
    written(tmp_path, frame_keys=[{"fl_x": 20.0}] * 9)
    assert nerfstudio.read(tmp_path).camera.fx_px == 20.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model is not supported"),
        ({"cx": "4"}, "`cx` must be a number"),
        ({"w": 12}, "images 8x6, intrinsics for 12x6"),
        ({"frame_keys": [{"fl_x": 10.0 + i} for i in range(9)]}, "must share one camera"),
        ({"train_filenames": ["nowhere.jpg"]}, "none of the frames is for training"),
    ],
)
def test_bad_files_are_refused(tmp_path, options, message):
    written(tmp_path, **options)
    with pytest.raises(CaptureError, match=re.escape(message)):
        nerfstudio.read(tmp_path)
