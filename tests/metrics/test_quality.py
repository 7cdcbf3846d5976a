import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.metrics.blur_cues import Overlap, depth_overlap, event_blur, flow_overlap
from sharpfield.metrics.quality import (
    Comparison,
    bending,
    chained,
    compared,
    event_quality,
    frame_quality,
    laplacian,
    quality_weights,
    reconciled,
    window_weights,
)
from sharpfield.preparation.quality import rank_correlation
from sharpfield.simulation.room_capture import RoomTiming, simulate_room
from sharpfield.simulation.static_capture import Rig


@pytest.fixture(scope="module")
def walked():
    timing = RoomTiming(frames=21, events=True, step_us=10_000)
    return simulate_room(rig=Rig(size=(96, 72)), timing=timing, seed=1)


def test_published_numbers_of_windows():
    expected = [0.181818, 0.363636, 0.545455, 0.727273, 0.909091, 0.878788]
    expected += [1.025253, 1.171717, 1.318182, 1.464646, 1.222222, 1.333333]
    np.testing.assert_allclose(window_weights(np.arange(1.0, 13.0)), expected, atol=1e-6)
    alternating = np.tile([4.0, 1.0], 8)[:15]
    np.testing.assert_allclose(window_weights(alternating), np.tile([1.6, 0.4], 8)[:15])


def test_weights_of_equal_scores_are_one_and_scale_does_not_matter():
    scores = np.random.default_rng(0).uniform(1, 9, 33)
    np.testing.assert_allclose(window_weights(np.full(7, 3.0)), 1)
    np.testing.assert_allclose(window_weights(5 * scores), window_weights(scores))
    assert window_weights(scores).mean() == pytest.approx(1, abs=0.1)
    assert len(window_weights(np.zeros(0))) == 0


def test_published_numbers_of_the_chain():
    found = chained(np.array([10.0, 8.0, 12.0]), np.array([9.0, 10.0, 11.0]))
    np.testing.assert_allclose(found, [10, 9, 11.25])


def test_agreeing_comparisons_are_met_exactly():
    true = np.array([3.0, 1.0, 4.0, 1.5, 9.0])
    pairs = [
        Comparison(i, j, 7 * true[i], 7 * true[j], 0.8) for i in range(5) for j in range(i + 1, 5)
    ]
    found = reconciled(np.full(5, 2.0), pairs, anchor=1e-6)
    np.testing.assert_allclose(found / found[0], true / true[0], rtol=1e-4)
    assert np.log(found).mean() == pytest.approx(np.log(2.0), abs=1e-6)
    alone = reconciled(true, [Comparison(0, 1, 1.0, 2.0, 0.0)], anchor=0.1)
    np.testing.assert_allclose(alone, true, rtol=1e-6)


def test_the_laplacian_is_that_of_a_slow_loop():
    image = np.random.default_rng(3).integers(0, 256, (14, 17)).astype(np.uint8)
    padded = np.pad(image.astype(float), 3, mode="reflect")
    smooth = np.array(
        [[padded[r + 1 : r + 6, c + 1 : c + 6].mean() for c in range(17)] for r in range(14)]
    )
    expected = (
        smooth[:-2, 1:-1] + smooth[2:, 1:-1] + smooth[1:-1, :-2] + smooth[1:-1, 2:]
    ) - 4 * smooth[1:-1, 1:-1]
    np.testing.assert_allclose(laplacian(image)[1:-1, 1:-1], expected, atol=1e-3)


def test_bending_is_lost_along_the_blur():
    image = np.random.default_rng(4).integers(0, 256, (60, 60)).astype(np.uint8)
    across = cv2.blur(image, (9, 1))
    kept = [float(b.var() / a.var()) for a, b in zip(bending(image), bending(across), strict=True)]
    assert kept[0] < 0.3 * kept[1]


def test_depth_overlap_finds_the_same_points(walked):
    """Where two frames show the same, the sharp images have the same colour."""
    size = 640, 480
    both = depth_overlap(walked, 3, 5, size)
    assert 0.2 < both.share < 1
    one, other = (
        cv2.resize(walked.frames.truth[i], size, interpolation=cv2.INTER_LINEAR).astype(int)
        for i in (3, 5)
    )
    here, there = (tuple(place.T) for place in (both.here, both.there))
    matched = np.abs(one[here] - other[there]).mean()
    unmatched = np.abs(one[here] - other[here]).mean()
    assert matched < 0.5 * unmatched
    same = depth_overlap(walked, 3, 3, size)
    np.testing.assert_array_equal(same.here, same.there)


def test_flow_overlap_follows_a_shift():
    draw = np.random.default_rng(5)
    wide = cv2.GaussianBlur(draw.integers(0, 256, (240, 360)).astype(np.uint8), (0, 0), 3)
    wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
    both = flow_overlap(np.ascontiguousarray(wide[:, 8:328]), np.ascontiguousarray(wide[:, 20:340]))
    shift = both.there - both.here
    assert abs(np.median(shift[:, 0])) <= 1
    assert np.median(shift[:, 1]) == pytest.approx(-12, abs=1)


def test_nothing_in_common_counts_nothing():
    image = np.zeros((8, 8), np.float32)
    nowhere = np.zeros((0, 2), np.int64)
    none = Overlap(nowhere, nowhere, 0.0)
    assert compared(0, 1, [image, image], none) == Comparison(0, 1, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def by_depth(walked):
    return frame_quality(walked)


@pytest.fixture(scope="module")
def by_events(walked):
    return event_quality(walked)


def test_scores_rank_frames_by_their_true_blur(walked, by_depth, by_events):
    true = walked.frames.blur_px[walked.split.train]
    assert rank_correlation(by_depth.scores, -true) > 0.9
    assert rank_correlation(by_events.scores, -true) > 0.95


def test_events_measure_blur_in_pixels(walked):
    true = walked.frames.blur_px[walked.split.train]
    found = event_blur(walked)
    assert np.median(np.abs(found - true) / (true + 0.3)) < 0.25
    assert event_blur(walked, frames=walked.split.test).max() < 0.5, "instants have no blur"


@pytest.mark.parametrize("source", ["auto", "images"])
def test_weights_are_of_all_frames_and_say_nothing_about_held_out_ones(
    walked, by_depth, by_events, source
):
    weights = quality_weights(walked, source=source)
    found = by_events if source == "auto" else by_depth
    np.testing.assert_array_equal(weights[walked.split.test], 1)
    np.testing.assert_allclose(weights[walked.split.train], found.weights)
    assert weights.shape == (21,) and found.weights.mean() == pytest.approx(1, abs=0.2)


def test_the_published_way_is_the_chain_of_neighbours(walked):
    found = frame_quality(walked, way="published", overlap="flow")
    assert len(found.scores) == len(walked.split.train) and (found.scores > 0).all()
    halved = replace(walked.frames, images=walked.frames.images // 2)
    dimmer = frame_quality(replace(walked, frames=halved), way="published", overlap="depth")
    whole = frame_quality(walked, way="published", overlap="depth")
    np.testing.assert_allclose(dimmer.weights, whole.weights, rtol=0.2)


def test_only_a_few_images_are_held_at_once(walked):
    """However long the video: 18 images of 640x480 with their responses are 49 MB."""
    for way in ("reconciled", "published"):
        tracemalloc.start()
        frame_quality(walked, way=way, overlap="depth")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 36e6


def test_errors_say_what_is_missing(walked):
    with pytest.raises(OptionError, match="the capture has no depth"):
        frame_quality(replace(walked, depth=None), overlap="depth")
    with pytest.raises(CaptureError, match="this needs events, and the capture has none"):
        event_quality(walked.without(events=True))
