from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Split
from sharpfield.evaluation.views import BLURRED, SHARP, TRUTH, held_out, trained_on
from sharpfield.report.colormaps import as_display
from tests.evaluation.fake import capture


def test_truth_comes_before_the_stored_image():
    whole = replace(capture(), split=Split(np.arange(4), np.array([4, 5])))
    kinds = {reference.name: reference.kind for reference in held_out(whole)}
    assert kinds == {"04": SHARP, "05": TRUTH}
    truth = whole.needed_frames.truth
    assert truth is not None
    torch.testing.assert_close(held_out(whole)[1].image, as_display(truth[5]))
    measured = as_display(whole.needed_frames.images[5])
    torch.testing.assert_close(held_out(whole)[1].measured, measured)


def test_an_exposed_image_without_truth_is_called_blurred():
    whole = replace(capture(truth=False), split=Split(np.arange(5), np.array([5])))
    assert held_out(whole)[0].kind == BLURRED


def test_training_views_need_truth_to_be_scored():
    assert [one.frame for one in trained_on(capture())] == [1, 2, 3, 5]
    assert {one.kind for one in trained_on(capture())} == {TRUTH}
    without = trained_on(capture(truth=False))
    assert [one.frame for one in without] == [1, 3, 5] or [one.frame for one in without] == [
        1,
        2,
        5,
    ]
    assert all(one.image is None and one.kind == "" for one in without)
    assert trained_on(capture(truth=False), limit=0) == []


def test_no_frames_no_references():
    blind = capture().without(frames=True)
    assert held_out(blind) == [] and trained_on(blind) == []


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_white_is_one_whatever_the_depth(dtype):
    image = np.array([[[0, np.iinfo(dtype).max, np.iinfo(dtype).max // 5]]], dtype)
    assert as_display(image).flatten().tolist() == pytest.approx([0, 1, 0.2], abs=1e-6)


def test_float_images_are_left_alone():
    assert as_display(np.full((1, 1, 1), 0.25)).item() == 0.25
