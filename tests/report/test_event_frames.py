from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.report.event_frames import (
    count_events,
    signed,
    windows,
    without_low_counts,
    writing_frames,
)
from sharpfield.storage.images import read_image
from tests.evaluation.fake import random_events


def frames_of(events: EventStream, edges: list[int]) -> list[np.ndarray]:
    pairs = zip([0, *edges[:-1]], edges, strict=True)
    return [count_events(events.window(*pair)) for pair in pairs]


def write_frames(folder: Path, counts: list[np.ndarray], *, least_share: float = 0.0) -> None:
    with writing_frames(folder, len(counts), least_share=least_share) as append:
        for part in counts:
            append(part)


def test_frames_of_windows_add_up_to_the_stream():
    events = random_events(2000)
    edges = windows(0, 1_000_000, 130_000)
    assert edges[-2:] == [910_000, 1_000_000]
    counts = frames_of(events, edges)
    np.testing.assert_array_equal(sum(counts), count_events(events))
    assert sum(part.sum() for part in counts) == 2000
    slow = np.zeros((32, 40), int)
    for x, y, p in zip(events.x, events.y, events.p, strict=True):
        slow[y, x] += p
    np.testing.assert_array_equal(signed(count_events(events)), slow)


def test_few_events_are_left_out_by_the_frames_own_largest_count():
    """The released images keep 3 of 10 and 2 of 6, and drop 2 of 7 and 1 of 6."""
    frames = np.array(
        [[[10, -3, 2, 0]], [[-7, 2, 3, -2]], [[6, 2, -1, -2]], [[0, 0, 0, 0]]], np.int32
    )
    left = without_low_counts(frames, 0.3)
    expected = [[[10, -3, 0, 0]], [[-7, 0, 3, 0]], [[6, 2, 0, -2]], [[0, 0, 0, 0]]]
    np.testing.assert_array_equal(left, expected)
    np.testing.assert_array_equal(without_low_counts(-frames, 0.3), -left)
    np.testing.assert_array_equal(without_low_counts(frames, 0.0), frames)


def test_a_folder_holds_arrays_images_and_a_video(tmp_path):
    counts = frames_of(random_events(20_000), windows(0, 1_000_000, 250_000))
    for _ in range(2):  # the second takes the place of the first
        write_frames(tmp_path / "frames", counts, least_share=0.5)
    np.testing.assert_array_equal(np.load(tmp_path / "frames" / "counts.npy"), counts)
    frames = np.load(tmp_path / "frames" / "frames.npy")
    np.testing.assert_array_equal(frames, without_low_counts(signed(np.stack(counts)), 0.5))
    image = read_image(tmp_path / "frames" / "0003.png").astype(int)
    red, blue = (image[..., a] > image[..., b] for a, b in ((0, 2), (2, 0)))
    np.testing.assert_array_equal(red, frames[3] > 0)
    np.testing.assert_array_equal(blue, frames[3] < 0)
    assert (tmp_path / "frames" / "frames.mp4").stat().st_size > 0
    assert len(list((tmp_path / "frames").iterdir())) == 4 + 3


def test_windows_without_any_event_are_white(tmp_path):
    write_frames(tmp_path / "frames", [np.zeros((4, 6, 2), np.int32)])
    assert (read_image(tmp_path / "frames" / "0000.png") == 255).all()


def test_other_folders_are_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OptionError, match="other files than event frames"):
        write_frames(tmp_path, [np.zeros((4, 6, 2), np.int32)])
    assert (tmp_path / "thesis.tex").exists()


def test_windows_need_a_length():
    with pytest.raises(OptionError, match="windows must have a length"):
        windows(0, 10, 0)
