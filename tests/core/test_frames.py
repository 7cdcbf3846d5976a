import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure, Frames


def frames(opens: list[int], closes: list[int], tracks: list[int], **more: object) -> Frames:
    count = len(opens)
    given: dict = {
        "images": np.zeros((count, 3, 4, 3), np.uint8),
        "exposure": Exposure(np.array(opens, np.int64), np.array(closes, np.int64)),
        "track": np.array(tracks, np.int64),
        "names": tuple(f"{i:04d}.png" for i in range(count)),
    }
    return Frames(**{**given, **more})


def test_sizes():
    made = frames([0, 10], [5, 15], [0, 0])
    assert (len(made), made.width, made.height, made.channels) == (2, 4, 3, 3)


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_white(kind: type, white: int):
    assert frames([0], [1], [0], images=np.zeros((1, 2, 2, 1), kind)).white == white


TRUTH = np.zeros((2, 3, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("more", "known"),
    [
        ({}, [False, False]),
        ({"truth_known": np.ones(2, bool)}, [False, False]),
        ({"truth": TRUTH}, [True, True]),
        ({"truth": TRUTH, "truth_known": np.array([1, 0], np.uint8)}, [True, False]),
    ],
)
def test_which_frames_have_a_sharp_truth(more: dict, known: list[bool]):
    assert frames([0, 10], [5, 15], [0, 0], **more).with_truth.tolist() == known


def test_exposures_may_touch_and_come_in_any_order():
    assert len(frames([10, 0, 20], [20, 10, 30], [0, 0, 0])) == 3


def test_exposures_on_different_tracks_may_overlap():
    assert len(frames([0, 0], [10, 10], [0, 1])) == 2


def test_instants_in_one_exposure_of_another_track():
    assert len(frames([5, 0], [5, 10], [1, 0])) == 2


def test_no_frames():
    assert len(frames([], [], [])) == 0


def test_overlapping_exposures_on_one_track():
    with pytest.raises(CaptureError) as refused:
        frames([0, 100, 50], [40, 120, 101], [0, 3, 3])
    assert str(refused.value) == (
        "CaptureError: frames 2 and 1 overlap in time\n"
        "  where  exposures of 0002.png and 0001.png (track 3)\n"
        "  got    one closes at 101 us, the next opens at 100 us\n"
        "  do     check the exposure times; a second camera is a second track"
    )


def test_counts_that_disagree():
    with pytest.raises(CaptureError) as refused:
        frames([0, 1], [0, 1], [0, 0], names=("a",))
    assert str(refused.value) == (
        "CaptureError: there must be one exposure, track and name for each image\n"
        "  got    2 images, 2 exposures, 2 tracks, 1 names"
    )


def test_an_unknown_encoding():
    with pytest.raises(CaptureError) as refused:
        frames([0], [1], [0], encoding="rec709")
    assert str(refused.value) == (
        "CaptureError: unknown image encoding\n"
        "  got    rec709\n"
        "  do     use one of linear, gamma2.2, srgb"
    )
