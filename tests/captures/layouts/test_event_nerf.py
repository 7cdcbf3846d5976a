from pathlib import Path

import numpy as np
import pytest
import torch

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.read import layout_of, read_capture
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image

WIDTH, HEIGHT, POSES, COUNT = 346, 260, 5, 400


def numbers(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" ".join(f"{v:.17g}" for v in np.ravel(values)))


def pose(i: int) -> np.ndarray:
    angle = 0.3 * i
    matrix = np.eye(4)
    matrix[0, [0, 2]] = np.cos(angle), np.sin(angle)
    matrix[2, [0, 2]] = -np.sin(angle), np.cos(angle)
    matrix[:3, 3] = [-3 * np.sin(angle), 0.1, -3 * np.cos(angle)]
    return matrix


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    draw = np.random.default_rng(0)
    train = tmp_path / "train"
    intrinsics = np.eye(4)
    intrinsics[:2, :3] = [[480, 0, 173], [0, 481, 130]]
    for i in range(POSES):
        numbers(train / "pose" / f"r_{i:05d}.txt", pose(i))
        numbers(train / "intrinsics" / f"r_{i:05d}.txt", intrinsics)
    events = train / "events" / "scene.npz"
    events.parent.mkdir()
    np.savez(
        events,
        x=draw.integers(0, WIDTH, COUNT),
        y=draw.integers(0, HEIGHT, COUNT),
        t=np.append(np.sort(draw.random(COUNT - 1)) * 2.0, 2.0),
        p=draw.choice([-1, 1], COUNT),
    )
    numbers(tmp_path / "test" / "pose" / "r_0.txt", pose(9))
    write_image(tmp_path / "test" / "rgb" / "r_0.png", np.full((HEIGHT, WIDTH, 3), 9, np.uint8))
    return tmp_path


def test_poses_are_spread_over_the_events(folder: Path) -> None:
    found = read_capture(folder, ReadOptions(event_unit="s"))
    assert layout_of(folder) == found.source == "event-nerf"
    assert found.clock.span_us == 2_000_000 and found.needed_events.bayer == "RGGB"
    assert len(found.needed_events) == COUNT
    track = torch.zeros(2, dtype=torch.int64)
    poses = found.trajectory.pose(torch.tensor([0.25, 0.375]), track).double().numpy()
    np.testing.assert_allclose(poses[0], pose(1)[:3], atol=1e-6)
    middle = (pose(1) + pose(2))[:3, 3] / 2  # a straight line
    np.testing.assert_allclose(poses[1][:, 3], middle, atol=1e-6)
    assert (found.camera.fx_px, found.camera.fy_px, found.camera.cx_px) == (480, 481, 173)
    assert found.near < 3 < found.far


def test_other_views_are_held_out(folder: Path) -> None:
    found = read_capture(folder, ReadOptions(event_unit="s"))
    assert len(found.split.train) == 0 and found.split.test.tolist() == [0]
    assert found.needed_frames.names == ("test/r_0",)
    np.testing.assert_allclose(found.frame_pose(np.array([0]))[0], pose(9)[:3], atol=1e-6)


def test_images_along_the_path_are_on_it(folder: Path) -> None:
    for i in range(POSES):
        image = np.full((HEIGHT, WIDTH, 3), i, np.uint8)
        write_image(folder / "train" / "rgb" / f"r_{i:05d}.png", image)
    found = read_capture(folder, ReadOptions(event_unit="s"))
    np.testing.assert_array_equal(found.split.train, np.arange(5))
    np.testing.assert_allclose(found.frame_pose(np.array([3]))[0], pose(3)[:3], atol=1e-6)
    (folder / "train" / "rgb" / "r_00000.png").unlink()
    with pytest.raises(CaptureError, match="a pose for each train image"):
        read_capture(folder, ReadOptions(event_unit="s"))


def test_the_unit_is_never_guessed(folder: Path) -> None:
    with pytest.raises(CaptureError, match="do not state the unit") as caught:
        read_capture(folder)
    assert "--event-unit" in str(caught.value)


def test_distortion_is_in_the_fifth_row(folder: Path) -> None:
    path = folder / "train" / "intrinsics" / "r_00000.txt"
    path.write_text(path.read_text() + " -0.3 0.1 0 0")
    camera = read_capture(folder, ReadOptions(event_unit="s")).camera
    assert camera.lens == "brown" and camera.distortion == (-0.3, 0.1, 0, 0, 0)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("pose/r_00001.txt", "1 2 three", "cannot read the numbers of a text"),
        ("pose/r_00001.txt", "1 2 3", "there must be 16 numbers"),
        ("intrinsics/r_00000.txt", "1 2 3", "there must be 16 or 20 numbers"),
    ],
)
def test_malformed_text_is_told(folder: Path, name: str, text: str, message: str) -> None:
    (folder / "train" / name).write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_capture(folder, ReadOptions(event_unit="s"))
