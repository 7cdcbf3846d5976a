import json

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.preparation.quality import blur_images
from sharpfield.simulation.sensors.motion_blur import KernelRange
from sharpfield.storage.images import read_image, write_image


@pytest.fixture
def folder(tmp_path):
    draw = np.random.default_rng(0)
    for i in range(6):
        write_image(tmp_path / "in" / f"p{i}.png", draw.integers(0, 256, (20, 30, 3), np.uint8))
    return tmp_path / "in"


def test_names_and_sizes_stay_and_sharp_ones_are_copied(folder, tmp_path):
    half = KernelRange(probability=0.5)
    rows = blur_images(folder, tmp_path / "out", ranges=half, seed=2)
    told = json.loads((tmp_path / "out" / "blur.json").read_text())
    assert told["images"] == rows and told["k"] == [3, 16] and told["probability"] == 0.5
    assert 0 < sum(row["blurred"] for row in rows) < 6
    for row in rows:
        before, after = (read_image(place / row["name"]) for place in (folder, tmp_path / "out"))
        assert before.shape == after.shape
        assert np.array_equal(before, after) is not row["blurred"]
        assert not row["blurred"] or 3 <= row["k"] < 16
    assert blur_images(folder, tmp_path / "out", ranges=half, seed=2) == rows


def test_nothing_is_left_when_a_image_cannot_be_read(folder, tmp_path):
    (folder / "p9.png").write_bytes(b"not a image")
    with pytest.raises(CaptureError, match="cannot decode image"):
        blur_images(folder, tmp_path / "out", ranges=KernelRange(probability=1.0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_other_folders_are_not_replaced(folder, tmp_path):
    with pytest.raises(
        CaptureError, match="will not replace a folder that is not an earlier result"
    ):
        blur_images(folder, folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match="there are no images"):
        blur_images(tmp_path / "empty", tmp_path / "out")
