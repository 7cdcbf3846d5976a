"""Layouts of depth cameras: each is written here by hand, and read back."""

import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.layouts._rgbd import downscaled_camera, usable_poses
from sharpfield.captures.read import layout_of, read_capture
from sharpfield.captures.writers import scannet as write_scannet
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import DepthMaps
from sharpfield.storage.images import write_image
from tests.streams import HEIGHT, WIDTH

COUNT = 12


@pytest.fixture
def poses() -> np.ndarray:
    """World-from-camera, each turned and shifted."""
    made = np.tile(np.eye(4), (COUNT, 1, 1))
    for i in range(COUNT):
        turn, _ = cv2.Rodrigues(np.array([0.1 * i, -0.05 * i, 0.02]))
        made[i, :3, :3], made[i, :3, 3] = turn, [0.1 * i, 0.2, -0.3]
    return made


@pytest.fixture
def colours() -> np.ndarray:
    """Even colours, which JPEG keeps."""
    ground = np.linspace(20, 230, COUNT).astype(np.uint8)
    return np.broadcast_to(ground[:, None, None, None], (COUNT, 48, 64, 3)).copy()


@pytest.fixture
def depths() -> np.ndarray:
    return np.random.default_rng(0).integers(400, 7000, (COUNT, 24, 32)).astype(np.uint16)


def exported(folder, poses, colours, depths):
    for i in range(COUNT):
        write_image(folder / "color" / f"{i}.jpg", colours[i])
        write_image(folder / "depth" / f"{i}.png", depths[i][..., None])
        (folder / "pose").mkdir(parents=True, exist_ok=True)
        np.savetxt(folder / "pose" / f"{i}.txt", poses[i])
    (folder / "intrinsic").mkdir()
    colour = np.diag([55.0, 56.0, 1, 1])
    colour[:2, 2] = 31, 23
    depth = np.diag([27.0, 28.0, 1, 1])
    depth[:2, 2] = 15, 11
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", colour)
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", depth)


@pytest.mark.parametrize("inner", ["", "exported"])
def test_scannet(tmp_path, poses, colours, depths, inner):
    exported(tmp_path / inner, poses, colours, depths)
    assert layout_of(tmp_path) == "scannet"
    made = read_capture(tmp_path)
    np.testing.assert_array_equal(made.depth.stored, depths)
    np.testing.assert_allclose(made.frames.images.astype(int), colours, atol=2)
    np.testing.assert_allclose(made.frame_pose(np.arange(COUNT)), poses[:, :3], atol=1e-6)
    assert made.camera == Camera(64, 48, 55.0, 56.0, 31.0, 23.0)
    assert made.depth.camera == Camera(32, 24, 27.0, 28.0, 15.0, 11.0)
    np.testing.assert_array_equal(made.split.train, [0, 5, 10])
    assert len(made.split.test) == 9 and (made.near, made.far) == (0.1, 8.0)
    assert made.frames.names[10] == "10", "in the order of numbers"


def test_frames_without_a_pose_are_dropped_and_named(tmp_path, poses, colours, depths):
    poses[3, :3] = -np.inf
    poses[7, 0, 3] = np.nan
    poses[9, 1, 3] = 1e4
    exported(tmp_path, poses, colours, depths)
    made = read_capture(tmp_path)
    assert made.notes["dropped"] == "3 of 12 frames have no usable pose: 3, 7, 9"
    assert made.frames.names == tuple("0 1 2 4 5 6 8 10 11".split())
    np.testing.assert_array_equal(made.depth.stored, depths[[0, 1, 2, 4, 5, 6, 8, 10, 11]])
    np.testing.assert_array_equal(made.split.train, [0, 5])
    np.testing.assert_array_equal(usable_poses(poses[:, :3]).sum(), 9)


def test_frames_without_depth_or_pose_files(tmp_path, poses, colours, depths):
    exported(tmp_path, poses, colours, depths)
    (tmp_path / "depth" / "0.png").unlink()
    (tmp_path / "depth" / "4.png").unlink()
    (tmp_path / "pose" / "6.txt").unlink()
    (tmp_path / "color" / "Thumbs.db").write_bytes(b"x")
    made = read_capture(tmp_path)
    assert made.notes["dropped"] == "1 of 12 frames have no usable pose: 6"
    assert made.notes["without_depth"] == "2 of 12 frames have no depth: 0, 4"
    kept = np.delete(np.arange(COUNT), 6)
    depths[[0, 4]] = 0
    np.testing.assert_array_equal(made.depth.stored, depths[kept])
    for file in (tmp_path / "depth").glob("*.png"):
        file.unlink()
    assert read_capture(tmp_path).depth is None


def test_intrinsics_of_another_size_are_refused(tmp_path, poses, colours, depths):
    exported(tmp_path, poses, colours, depths)
    matrix = np.diag([1170.0, 1170.0, 1, 1])
    matrix[:2, 2] = 648, 484
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", matrix)
    with pytest.raises(CaptureError, match="the intrinsics do not belong to the images"):
        read_capture(tmp_path)


def test_no_pose_at_all_is_an_error(tmp_path, poses, colours, depths):
    exported(tmp_path, np.full_like(poses, -np.inf), colours, depths)
    with pytest.raises(CaptureError, match="no frame has a usable pose"):
        read_capture(tmp_path)


def test_large_colour_is_brought_to_the_published_size():
    camera = downscaled_camera(Camera(1296, 968, 1170.0, 1172.0, 648.0, 484.0), (640, 480))
    assert camera.size == (640, 480)
    np.testing.assert_allclose([camera.fx_px, camera.fy_px], [577.7778, 581.157], atol=1e-3)
    small = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
    assert downscaled_camera(small, (640, 480)) is small


@pytest.mark.parametrize(
    ("size", "expected"),
    [((968, 1296), (480, 640)), ((1920, 1080), (640, 360)), ((1080, 1920), (360, 640))],
)
def test_large_colour_of_other_shapes_keeps_its_shape(size, expected):
    width, height = size
    camera = downscaled_camera(
        Camera(width, height, 900.0, 900.0, width / 2, height / 2), (640, 480)
    )
    assert camera.size == expected
    np.testing.assert_allclose(camera.fx_px / camera.fy_px, 1, atol=0.01)
    np.testing.assert_allclose([camera.cx_px, camera.cy_px], np.array(expected) / 2)


def with_depth(panning: Capture) -> Capture:
    maps = np.random.default_rng(1).integers(0, 9000, (9, HEIGHT, WIDTH)).astype(np.uint16)
    even = np.broadcast_to(panning.frames.images[:, :1, :1], panning.frames.images.shape).copy()
    return replace(
        panning,
        frames=replace(
            panning.frames,
            images=even,
            truth=even,
            truth_known=np.arange(9) % 2 == 0,
            blur_px=np.linspace(0, 4, 9),
        ),
        events=None,
        depth=DepthMaps(maps, panning.camera),
    )


def test_what_is_written_for_scannet_is_read_again(panning, tmp_path):
    capture = with_depth(panning)
    write_scannet.write(capture, tmp_path / "scene")
    made = read_capture(tmp_path / "scene", ReadOptions(encoding="gamma2.2"))
    np.testing.assert_array_equal(made.depth.stored, capture.depth.stored)
    np.testing.assert_allclose(
        made.frame_pose(np.arange(9)), capture.frame_pose(np.arange(9)), atol=1e-6
    )
    np.testing.assert_allclose(made.frames.images.astype(int), capture.frames.images, atol=6)
    np.testing.assert_array_equal(made.frames.truth_known, capture.frames.truth_known)
    np.testing.assert_array_equal(made.frames.truth[::2], capture.frames.truth[::2])
    np.testing.assert_allclose(made.frames.blur_px, capture.frames.blur_px)
    assert made.camera == capture.camera


def test_scannet_has_no_place_for_events(panning, tmp_path):
    capture = replace(with_depth(panning), events=panning.events)
    with pytest.raises(CaptureError, match="the layout scannet cannot store events"):
        write_scannet.write(capture, tmp_path / "scene")
    with pytest.raises(CaptureError, match="needs measured depth"):
        write_scannet.write(panning.without(events=True), tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def sens(path, poses, colours, depths, *, cut=0, version=4):
    data = struct.pack("<IQ", version, 4) + b"test"
    matrix = np.eye(4, dtype="<f4")
    colour, depth = matrix.copy(), matrix.copy()
    colour[[0, 1, 0, 1], [0, 1, 2, 2]] = 55, 56, 31, 23
    depth[[0, 1, 0, 1], [0, 1, 2, 2]] = 27, 28, 15, 11
    for one in (colour, matrix, depth, matrix):
        data += one.tobytes()
    data += struct.pack("<iiIIIIfQ", 2, 1, 64, 48, 32, 24, 1000.0, COUNT)
    for i in range(COUNT):
        jpeg = cv2.imencode(".jpg", colours[i])[1].tobytes()
        packed = zlib.compress(depths[i].astype("<u2").tobytes())
        data += poses[i].astype("<f4").tobytes()
        data += struct.pack("<QQQQ", i, i, len(jpeg), len(packed)) + jpeg + packed
    path.write_bytes(data[: len(data) - cut])


def test_sens(tmp_path, poses, colours, depths):
    poses[2] = -np.inf
    sens(tmp_path / "scene.sens", poses, colours, depths)
    assert layout_of(tmp_path) == "sens"
    made = read_capture(tmp_path)
    kept = np.delete(np.arange(COUNT), 2)
    np.testing.assert_array_equal(made.depth.stored, depths[kept])
    np.testing.assert_allclose(made.frames.images.astype(int), colours[kept], atol=2)
    np.testing.assert_allclose(made.frame_pose(np.arange(11)), poses[kept, :3], atol=1e-6)
    assert made.camera == Camera(64, 48, 55.0, 56.0, 31.0, 23.0)


@pytest.mark.parametrize(
    ("damage", "message"),
    [({"cut": 5}, "ends too early"), ({"version": 3}, "unsupported version of a .sens file")],
)
def test_broken_sens_files(tmp_path, poses, colours, depths, damage, message):
    sens(tmp_path / "scene.sens", poses, colours, depths, **damage)
    with pytest.raises(CaptureError, match=message):
        read_capture(tmp_path)


def test_7_scenes(tmp_path, poses, colours, depths):
    depths[0, 0, 0] = 65535
    for i in range(COUNT):
        place = tmp_path / f"seq-{1 + i % 3:02d}"
        stem = f"frame-{i // 3:06d}"
        write_image(place / f"{stem}.color.png", colours[i])
        write_image(place / f"{stem}.depth.png", depths[i].repeat(2, 0).repeat(2, 1)[..., None])
        np.savetxt(place / f"{stem}.pose.txt", poses[i])
    one = read_capture(tmp_path / "seq-01")
    assert one.source == "7-scenes" and one.frames.names == ("000000", "000001", "000002", "000003")
    assert one.camera.fx_px == 585 / 10 and one.depth.at(0)[0, 0] == 0
    np.testing.assert_array_equal(one.frames.images, colours[::3])
    (tmp_path / "TrainSplit.txt").write_text("sequence1\nsequence3\n")
    (tmp_path / "TestSplit.txt").write_text("sequence2\n")
    scene = read_capture(tmp_path)
    assert [scene.frames.names[i][:6] for i in scene.split.test] == ["seq-02"] * 4
    assert len(scene.split.train) == 8


def test_arkitscenes(tmp_path, poses, colours, depths):
    lines = []
    for i in range(COUNT):  # a pose every 0.1 s, an image in the middle of two
        inverse = np.linalg.inv(poses[i])
        turn, _ = cv2.Rodrigues(inverse[:3, :3])
        lines.append([100 + 0.1 * i, *turn[:, 0], *inverse[:3, 3]])
        stem = f"40776204_{100.05 + 0.1 * i:.3f}"
        write_image(tmp_path / "lowres_wide" / f"{stem}.png", colours[i])
        write_image(
            tmp_path / "lowres_depth" / f"{stem}.png",
            depths[i].repeat(2, 0).repeat(2, 1)[..., None],
        )
        (tmp_path / "lowres_wide_intrinsics").mkdir(exist_ok=True)
        focal = 53 + 0.1 * i
        (tmp_path / "lowres_wide_intrinsics" / f"{stem}.pincam").write_text(
            f"64 48 {focal} {focal} 32.5 23.5\n"
        )
    np.savetxt(tmp_path / "lowres_wide.traj", lines)
    made = read_capture(tmp_path)
    assert made.source == "arkitscenes" and len(made.frames) == COUNT - 1
    assert made.notes["dropped"].startswith("1 of 12 frames have no usable pose: 40776204_101.150")
    found = made.frame_pose(np.arange(COUNT - 1)).double().numpy()
    middle = 0.5 * (poses[:-1, :3, 3] + poses[1:, :3, 3])
    np.testing.assert_allclose(found[:, :, 3], middle, atol=1e-4)
    halfway = cv2.Rodrigues(found[4, :, :3] @ poses[4, :3, :3].T)[0]
    whole = cv2.Rodrigues(poses[5, :3, :3] @ poses[4, :3, :3].T)[0]
    np.testing.assert_allclose(halfway, whole / 2, atol=1e-4)
    np.testing.assert_allclose(made.camera.fx_px, 53.55, atol=1e-9)
    np.testing.assert_allclose(made.notes["focal_spread"], 1.1 / 53.55, rtol=1e-6)


def test_arkitscenes_with_depth_at_half_the_rate(tmp_path, poses, colours, depths):
    lines = []
    for i in range(COUNT):  # names are a millisecond off
        inverse = np.linalg.inv(poses[i])
        turn, _ = cv2.Rodrigues(inverse[:3, :3])
        lines.append([100 + 0.016 * i, *turn[:, 0], *inverse[:3, 3]])
        write_image(tmp_path / "lowres_wide" / f"1_{100 + 0.016 * i:.3f}.png", colours[i])
        if i % 2:
            name = f"1_{100.001 + 0.016 * i:.3f}"
            map_ = depths[i].repeat(2, 0).repeat(2, 1)[..., None]
            write_image(tmp_path / "lowres_depth" / f"{name}.png", map_)
            (tmp_path / "lowres_wide_intrinsics").mkdir(exist_ok=True)
            (tmp_path / "lowres_wide_intrinsics" / f"{name}.pincam").write_text("64 48 53 53 32 24")
    np.savetxt(tmp_path / "lowres_wide.traj", lines)
    made = read_capture(tmp_path)
    assert len(made.frames) == COUNT and "dropped" not in made.notes
    assert made.notes["without_depth"].startswith("6 of 12 frames have no depth: 1_100.000, 1_100.")
    assert not made.depth.stored[::2].any()
    np.testing.assert_array_equal(made.depth.stored[1::2, ::2, ::2], depths[1::2])
