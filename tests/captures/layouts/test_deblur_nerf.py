import re
import shutil

import numpy as np
import pytest
import torch

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.layouts import deblur_nerf
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image


def written(folder, count=9, size=(6, 8), stored=(24, 32, 40.0)):
    """A scene whose camera i sits at (i, 2i, 3i), with axes that differ from the world's."""
    images = np.random.default_rng(0).integers(0, 256, (count, *size, 3), dtype=np.uint8)
    for i, image in enumerate(images):
        write_image(folder / "images_4" / f"{i:03d}.png", image)
    down, right, backward = np.eye(3)[[2, 0, 1]]
    rows = np.zeros((count, 17))
    for i, row in enumerate(rows):
        matrix = np.stack([down, right, backward, i * np.array([1.0, 2, 3]), stored], -1)
        row[:15], row[15:] = matrix.ravel(), (2.0 + i, 20.0)
    np.save(folder / "poses_bounds.npy", rows)
    return images


def test_axes_become_right_down_forward(tmp_path):
    written(tmp_path)
    pose = deblur_nerf.read(tmp_path).frame_pose(np.array([2]))[0]
    np.testing.assert_allclose(pose[:, 0], [1, 0, 0])  # right
    np.testing.assert_allclose(pose[:, 1], [0, 0, 1])  # down
    np.testing.assert_allclose(pose[:, 2], [0, -1, 0])  # forward: away from backward
    np.testing.assert_allclose(pose[:, 3], [2, 4, 6])


def test_the_focal_length_follows_the_images(tmp_path):
    images = written(tmp_path)
    capture = deblur_nerf.read(tmp_path)
    np.testing.assert_array_equal(capture.frames.images, images)
    assert capture.camera.size == (8, 6)
    assert capture.camera.fx_px == capture.camera.fy_px == pytest.approx(10.0)
    assert (capture.camera.cx_px, capture.camera.cy_px) == (4, 3)
    assert (capture.near, capture.far) == (2, 20)
    assert capture.known.motion == "unknown"


@pytest.mark.parametrize(
    ("marker", "option", "test"),
    [
        (None, None, [0, 8]),
        ("hold=4", None, [0, 4, 8]),
        ("hold=4", "every:3", [0, 3, 6]),
        (None, "none", []),
    ],
)
def test_what_is_held_out(tmp_path, marker, option, test):
    written(tmp_path)
    if marker:
        (tmp_path / marker).touch()
    split = deblur_nerf.read(tmp_path, ReadOptions(hold_out=option)).split
    assert split.test.tolist() == test
    assert sorted([*split.train, *split.test]) == list(range(9))


def test_the_smallest_images_are_read_unless_told(tmp_path):
    written(tmp_path)
    for i in range(9):
        write_image(tmp_path / "images" / f"{i}.jpg", np.zeros((24, 32, 3), np.uint8))
    assert deblur_nerf.read(tmp_path).camera.size == (8, 6)
    assert deblur_nerf.read(tmp_path, ReadOptions(factor=1)).camera.size == (32, 24)
    with pytest.raises(CaptureError, match=re.compile("factor 8.*images, images_4", re.DOTALL)):
        deblur_nerf.read(tmp_path, ReadOptions(factor=8))


def test_a_missing_image_is_told(tmp_path):
    written(tmp_path)
    (tmp_path / "images_4" / "003.png").unlink()
    with pytest.raises(CaptureError, match="8 images in images_4, 9 poses"):
        deblur_nerf.read(tmp_path)


def test_cropped_images_are_refused(tmp_path):
    written(tmp_path, size=(6, 6))
    with pytest.raises(CaptureError, match="images 6x6, intrinsics for 32x24"):
        deblur_nerf.read(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:, :15], "must have 17 columns"),
        (lambda rows: rows * np.where(np.arange(17) == 10, -1, 1), "not orthonormal"),
        (lambda rows: np.where(np.arange(17) == 3, np.nan, rows), "NaN"),
        (lambda rows: np.where(np.arange(17) == 15, -1, rows), "0 < near < far"),
        (lambda rows: rows + np.arange(9)[:, None] * (np.arange(17) == 14), "must have one size"),
    ],
)
def test_bad_pose_tables_are_refused(tmp_path, change, message):
    written(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(CaptureError, match=message):
        deblur_nerf.read(tmp_path)


def test_a_pickled_table_is_not_opened(tmp_path):
    written(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(CaptureError, match="poses_bounds.npy"):
        deblur_nerf.read(tmp_path)


def test_the_layout_is_recognised(tmp_path):
    assert not deblur_nerf.recognise(tmp_path)
    written(tmp_path)
    assert deblur_nerf.recognise(tmp_path)
    (tmp_path / "events.h5").touch()
    assert not deblur_nerf.recognise(tmp_path)


@pytest.fixture
def blurball(samples):
    return samples / "posed" / "deblurnerf_blurball"


def test_a_published_scene(blurball):
    capture = deblur_nerf.read(blurball)
    assert capture.frames.images.shape == (27, 400, 600, 3)
    assert capture.split.test.tolist() == [0, 7, 14, 21]
    assert capture.camera.fx_px == pytest.approx(421.1077, abs=1e-3)
    assert (capture.near, capture.far) == pytest.approx((10.8479, 29.7364), abs=1e-3)
    assert capture.points.shape == (1867, 3)


def test_the_points_of_a_published_scene_lie_in_view(blurball):
    capture = deblur_nerf.read(blurball)
    pose = capture.frame_pose(np.arange(27))
    points = torch.from_numpy(capture.points).float()
    seen = (points - pose[:, None, :, 3]) @ pose[:, :, :3]  # camera axes
    assert (seen[..., 2] > 0).all()
    xy = capture.camera.project(seen)
    inside = ((xy > 0) & (xy < torch.tensor([600.0, 400.0]))).all(-1)
    assert inside.float().mean() > 0.8


def test_points_of_another_reconstruction_are_left_out(blurball, tmp_path):
    shutil.copytree(blurball, tmp_path / "scene", copy_function=shutil.copyfile)
    for folder in [tmp_path / "scene", *(tmp_path / "scene").rglob("*/")]:
        folder.chmod(0o755)
    path = tmp_path / "scene" / "poses_bounds.npy"
    table = np.load(path)
    table[:, [3, 8, 13]] += 1.0  # elsewhere
    np.save(path, table)
    assert deblur_nerf.read(tmp_path / "scene").points is None
