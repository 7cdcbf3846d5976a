import numpy as np
import pytest

from sharpfield.core.events import EventStream
from sharpfield.report.colormaps import colour_depth, colour_error, eight_bit, event_image


def stream(x: list[float], t: list[int], p: list[int], dtype: type = np.int16) -> EventStream:
    return EventStream(
        x=np.array(x, dtype),
        y=np.zeros(len(x), dtype),
        t_us=np.array(t, np.int64),
        p=np.array(p, np.int8),
        width=4,
        height=2,
    )


def test_events_are_red_or_blue_on_white_inside_the_window():
    image = event_image(stream([0, 1, 2], [5, 6, 50], [1, -1, 1]), 0, 10)
    red, blue, outside = image[0, 0].astype(int), image[0, 1].astype(int), image[0, 2]
    assert red[0] > red[2] + 100 and blue[2] > blue[0] + 100
    assert outside.tolist() == image[1, 3].tolist() == [255, 255, 255]


def test_events_that_cancel_leave_white():
    assert (event_image(stream([1, 1], [1, 2], [1, -1]), 0, 9) == 255).all()


def test_no_events_and_rectified_events():
    assert (event_image(stream([], [], []), 0, 9) == 255).all()
    shifted = event_image(stream([1.4, -3.0], [1, 2], [1, 1], np.float32), 0, 9)
    assert (shifted != 255).any(-1).sum() == 1


def test_error_is_black_without_and_brightest_with_error():
    truth = np.full((2, 2, 3), 0.5)
    assert colour_error(truth, truth).max() <= 4
    wrong = truth.copy()
    wrong[0, 0] = 1
    image = colour_error(wrong, truth)
    assert image[0, 0].min() > 150 and image[1, 1].max() <= 4


def test_near_depth_is_bright_and_constant_depth_is_possible():
    image = colour_depth(np.array([[1.0, 2.0], [4.0, 50.0]]))
    assert image[0, 0].sum() > image[1, 1].sum()
    assert colour_depth(np.ones((3, 3))).shape == (3, 3, 3)


def test_rounding_to_eight_bit():
    assert eight_bit(np.array([[[0.0, 0.5, 1.0]]])).tolist() == [[[0, 128, 255]]]
    assert eight_bit(np.array([[[0.998]]])).item() == pytest.approx(254)
