import re
import struct

import numpy as np
import pytest
import torch

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.layouts import colmap, deblur_nerf
from sharpfield.captures.layouts.colmap import camera_of, find_model, read_model
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image

CAMERA = (7, 1, 32, 24, (40.0, 42.0, 16.0, 12.0))  # number, PINHOLE, size, fx fy cx cy
QUARTER = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # a quarter turn about y
IMAGES = [  # number, wxyz, translation, camera, name, points seen
    (12, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 7, "b.png", [100, 300]),
    (11, QUARTER, (1.0, 2.0, 3.0), 7, "a b.png", []),
]
POINTS = [(100, (0.0, 0.0, 4.0), [12]), (300, (1.0, 0.0, 8.0), [12, 99])]


def binary(folder):
    folder.mkdir(parents=True)
    number, model, width, height, parameters = CAMERA
    cameras = struct.pack("<QIIQQ4d", 1, number, model, width, height, *parameters)
    (folder / "cameras.bin").write_bytes(cameras)
    images = struct.pack("<Q", len(IMAGES))
    for number, wxyz, translation, camera, name, seen in IMAGES:
        images += struct.pack("<I7dI", number, *wxyz, *translation, camera)
        images += name.encode() + b"\0" + struct.pack("<Q", len(seen))
        for point in seen:
            images += struct.pack("<2dq", 1.0, 2.0, point)
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for number, xyz, track in POINTS:
        points += struct.pack("<Q3d3Bd", number, *xyz, 1, 2, 3, 0.5)
        points += struct.pack("<Q", len(track))
        for image in track:
            points += struct.pack("<2I", image, 0)
    (folder / "points3D.bin").write_bytes(points)


def text(folder):
    folder.mkdir(parents=True)
    number, _, width, height, parameters = CAMERA
    cameras = f"# cameras\n{number} PINHOLE {width} {height} {' '.join(map(str, parameters))}\n"
    (folder / "cameras.txt").write_text(cameras)
    images = "# images\n"
    for number, wxyz, translation, camera, name, seen in IMAGES:
        pose = " ".join(str(float(value)) for value in (*wxyz, *translation))
        points = " ".join(f"1.0 2.0 {point}" for point in seen)
        images += f"{number} {pose} {camera} {name}\n{points}\n"
    (folder / "images.txt").write_text(images)
    points = "# points\n"
    for number, xyz, track in POINTS:
        tracks = " ".join(f"{image} 0" for image in track)
        points += f"{number} {xyz[0]} {xyz[1]} {xyz[2]} 1 2 3 0.5 {tracks}\n"
    (folder / "points3D.txt").write_text(points)


def photos(folder, names=("a b.png", "b.png"), size=(24, 32)):
    for i, name in enumerate(names):
        write_image(folder / name, np.full((*size, 3), i, np.uint8))


@pytest.mark.parametrize("write", [binary, text])
def test_both_kinds_of_files_say_the_same(tmp_path, write):
    write(tmp_path / "sparse/0")
    model = read_model(find_model(tmp_path))
    assert model.names == ("a b.png", "b.png")
    camera = model.cameras[0]
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == CAMERA[4]
    # Camera-from-world turns x to -z; the camera is where its inverse sends the origin.
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(model.poses[0, :, :3], turn.T, atol=1e-15)
    np.testing.assert_allclose(model.poses[0, :, 3], -turn.T @ [1, 2, 3], atol=1e-15)
    np.testing.assert_array_equal(model.poses[1], np.eye(3, 4))
    np.testing.assert_array_equal(model.points, [[0, 0, 4], [1, 0, 8]])
    np.testing.assert_array_equal(model.seen, [[1, 0], [1, 1]])  # image 99 does not exist


def test_a_capture_of_it(tmp_path):
    binary(tmp_path / "sparse/0")
    photos(tmp_path / "images")
    capture = colmap.read(tmp_path)
    assert capture.frames.names == ("a b", "b")
    assert (capture.near, capture.far) == pytest.approx((4.004, 7.996))  # percentiles of 4 and 8
    assert capture.split.test.tolist() == [0]


def test_intrinsics_follow_smaller_copies_of_the_images(tmp_path):
    binary(tmp_path / "sparse/0")
    photos(tmp_path / "images")
    photos(tmp_path / "images_2", ("a b.jpg", "b.JPG"), size=(12, 16))
    camera = colmap.read(tmp_path).camera
    assert camera.size == (16, 12)
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (20, 21, 8, 6)
    assert colmap.read(tmp_path, ReadOptions(factor=1)).camera.fx_px == 40


def test_missing_photos_are_told_or_skipped(tmp_path):
    binary(tmp_path / "sparse/0")
    photos(tmp_path / "images", ("b.png",))
    with pytest.raises(CaptureError, match=re.compile("1 of 2 images are missing.*a b.png", re.S)):
        colmap.read(tmp_path)
    capture = colmap.read(tmp_path, ReadOptions(missing="skip", hold_out="none"))
    assert capture.frames.names == ("b",)
    np.testing.assert_array_equal(capture.trajectory.poses, np.eye(3, 4)[None])


def test_every_supported_lens():
    def lens(model, *parameters):
        camera = camera_of(model, 100, 80, tuple(map(float, parameters)), where="here")
        return camera.fx_px, camera.fy_px, camera.lens, camera.distortion

    pinhole = (50, 50, "pinhole", ())
    assert lens("SIMPLE_PINHOLE", 50, 40, 30) == pinhole
    assert lens("PINHOLE", 50, 60, 40, 30) == (50, 60, "pinhole", ())
    assert lens("SIMPLE_RADIAL", 50, 40, 30, 0) == pinhole
    assert lens("SIMPLE_RADIAL", 50, 40, 30, 0.1) == (50, 50, "brown", (0.1, 0, 0, 0, 0))
    assert lens("RADIAL", 50, 40, 30, 0.1, 0.2) == (50, 50, "brown", (0.1, 0.2, 0, 0, 0))
    brown = (50, 60, "brown", (1, 2, 3, 4, 0))
    assert lens("OPENCV", 50, 60, 40, 30, 1, 2, 3, 4) == brown
    assert lens("OPENCV_FISHEYE", 50, 60, 40, 30, 0, 0, 0, 0)[2:] == ("fisheye", (0, 0, 0, 0))
    with pytest.raises(CaptureError, match="camera model FOV is not supported"):
        lens("FOV", 50, 60, 40, 30, 1)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_files_are_refused(tmp_path, name):
    binary(tmp_path / "sparse/0")
    path = tmp_path / "sparse/0" / name
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(CaptureError, match=f"COLMAP file is truncated\n  where  {path}"):
        read_model(tmp_path / "sparse/0")
    path.write_bytes(struct.pack("<Q", 2**60))
    with pytest.raises(CaptureError, match="COLMAP file is truncated"):
        read_model(tmp_path / "sparse/0")


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_garbled_text_is_refused(tmp_path, name):
    text(tmp_path / "sparse/0")
    (tmp_path / "sparse/0" / name).write_text("1 what is this\n")
    with pytest.raises(CaptureError, match="cannot read a line.*\n.*\n  got    1 what is this"):
        read_model(tmp_path / "sparse/0")


def test_missing_files_are_told(tmp_path):
    binary(tmp_path / "sparse/0")
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.raises(CaptureError, match="COLMAP file not found"):
        read_model(tmp_path / "sparse/0")
    with pytest.raises(CaptureError, match="no COLMAP model"):
        colmap.read(tmp_path / "sparse/0/nowhere")


def test_photos_of_two_cameras_are_refused(tmp_path):
    text(tmp_path / "sparse/0")
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text() + "8 PINHOLE 32 24 41 42 16 12\n")
    images = tmp_path / "sparse/0/images.txt"
    images.write_text(images.read_text().replace(" 7 b.png", " 8 b.png"))
    photos(tmp_path / "images")
    with pytest.raises(CaptureError, match="must share one camera"):
        colmap.read(tmp_path)


def test_the_layout_is_recognised(tmp_path):
    binary(tmp_path / "sparse/0")
    assert not colmap.recognise(tmp_path)
    photos(tmp_path / "images")
    assert colmap.recognise(tmp_path)


def test_a_published_model_agrees_with_its_pose_table(samples):
    """`poses_bounds.npy` of the scene was made from the model by other software."""
    scene = samples / "posed" / "deblurnerf_blurball"
    ours, table = colmap.read(scene), deblur_nerf.read(scene)
    np.testing.assert_allclose(ours.trajectory.poses, table.trajectory.poses, atol=1e-12)
    assert ours.camera == table.camera
    assert (ours.near, ours.far) == pytest.approx((table.near, table.far), rel=1e-3)
    assert len(ours.frames) == 27
    assert ours.points.shape == (1867, 3)


def test_published_observations_lie_where_the_points_project(samples):
    scene = samples / "posed" / "deblurnerf_blurball"
    model = read_model(scene / "sparse/0")
    image, point = model.seen.T
    pose = torch.from_numpy(model.poses[image])
    seen = ((torch.from_numpy(model.points[point]) - pose[:, :, 3])[:, None] @ pose[:, :, :3])[:, 0]
    xy = model.cameras[0].project(seen)
    assert ((xy > 0) & (xy < torch.tensor([600.0, 400.0]))).all()


def test_rational_distortion_is_refused():
    """FULL_OPENCV is read as long as its k4, k5 and k6, which we lack, are zero."""
    inner = (50.0, 60.0, 40.0, 30.0)
    found = camera_of(
        "FULL_OPENCV", 80, 60, (*inner, 1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0, 0.0), where="x"
    )
    assert (found.lens, found.distortion) == ("brown", (1, 2, 3, 4, 5))
    with pytest.raises(CaptureError, match="FULL_OPENCV is not supported"):
        camera_of(
            "FULL_OPENCV", 80, 60, (*inner, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, 0.0), where="x"
        )
