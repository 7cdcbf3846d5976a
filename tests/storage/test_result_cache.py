from dataclasses import replace

import numpy as np
import pytest

from sharpfield.core.capture import Capture, Split
from sharpfield.storage.result_cache import kept


class Question:
    """Counts how often it has to be worked out."""

    def __init__(self) -> None:
        self.asked = 0

    def find(self) -> dict[str, np.ndarray]:
        self.asked += 1
        return {"answer": np.arange(3.0) + self.asked}


@pytest.fixture
def long(panning: Capture, tmp_path) -> Capture:
    """The panning capture with its images mapped, as those of long ones are."""
    images = np.lib.format.open_memmap(
        tmp_path / "images.npy", "w+", panning.frames.images.dtype, panning.frames.images.shape
    )
    images[:] = panning.frames.images
    images.flush()
    mapped = np.load(tmp_path / "images.npy", mmap_mode="r")
    return replace(panning, frames=replace(panning.frames, images=mapped))


def test_a_long_capture_is_asked_once(long):
    question = Question()
    answers = [kept(long, "sum", {"by": 1}, question.find)["answer"] for _ in range(3)]
    assert question.asked == 1
    for answer in answers:
        np.testing.assert_array_equal(answer, [1, 2, 3])


def test_a_short_capture_is_asked_each_time(panning, tmp_path):
    question = Question()
    for _ in range(2):
        kept(panning, "sum", {}, question.find)
    assert question.asked == 2


def test_whatever_the_answer_depends_on_asks_again(long):
    question = Question()
    kept(long, "sum", {"by": 1}, question.find)
    kept(long, "sum", {"by": 2}, question.find)
    kept(long, "other", {"by": 1}, question.find)
    kept(
        replace(long, split=Split(long.split.train[1:], long.split.test)),
        "sum",
        {"by": 1},
        question.find,
    )
    kept(replace(long, far=long.far + 1), "sum", {"by": 1}, question.find)
    wider = replace(long.camera, fx_px=long.camera.fx_px + 1)
    kept(replace(long, camera=wider), "sum", {"by": 1}, question.find)
    assert question.asked == 6


def test_images_written_again_ask_again(long):
    question = Question()
    kept(long, "sum", {}, question.find)
    path = long.frames.images.filename
    again = np.load(path)
    np.save(path, np.concatenate([again, again]))
    mapped = np.load(path, mmap_mode="r")[: len(again)]
    kept(replace(long, frames=replace(long.frames, images=mapped)), "sum", {}, question.find)
    assert question.asked == 2


def test_a_damaged_answer_is_found_again(long, tmp_path):
    question = Question()
    kept(long, "sum", {}, question.find)
    (file,) = tmp_path.glob("sum-*.npz")
    file.write_bytes(file.read_bytes()[:50])
    np.testing.assert_array_equal(kept(long, "sum", {}, question.find)["answer"], [2, 3, 4])
    np.testing.assert_array_equal(kept(long, "sum", {}, question.find)["answer"], [2, 3, 4])
