import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.tone import tone_of
from sharpfield.events.threshold import FixedThresholds
from sharpfield.initialisation.posed_images import Images, sharp_images
from sharpfield.simulation.static_capture import Rig, Timing, simulate

THRESHOLDS = FixedThresholds(0.2, 0.2)
"""Of the simulation."""


def off(images: Images, capture: Capture) -> float:
    """Root mean square difference to what is known to be true."""
    frames = capture.needed_frames
    stored = torch.from_numpy(frames.truth[capture.split.train] / frames.white)
    truth = tone_of(frames.encoding).decode(stored).numpy()
    return float(np.sqrt(((images.light - truth) ** 2).mean()))


@pytest.fixture(scope="module")
def shaken() -> Capture:
    """Exposures so long that the frames are visibly blurred."""
    timing = Timing(frames=3, exposure_us=150_000, interval_us=160_000, test_every=3)
    return simulate("tiles", rig=Rig(size=(64, 48)), timing=timing, seed=3)


def test_events_make_them_sharp(shaken):
    sharp = sharp_images(shaken, THRESHOLDS)
    blurred = sharp_images(shaken.without(events=True), THRESHOLDS)
    assert off(blurred, shaken) > 0.04
    assert off(sharp, shaken) < 0.6 * off(blurred, shaken)
    assert len(sharp) == 2 and sharp.light.dtype == np.float32


def test_without_events_they_are_the_frames(tiny):
    found = sharp_images(tiny.without(events=True), THRESHOLDS)
    stored = tone_of(tiny.frames.encoding).encode(torch.from_numpy(found.light))
    np.testing.assert_allclose(stored * 255, tiny.frames.images[tiny.split.train], atol=1e-2)


def test_of_many_frames_a_few_are_taken_from_all_over(tiny):
    train = tiny.split.train
    few = sharp_images(tiny, THRESHOLDS, most=3)
    whole = sharp_images(tiny, THRESHOLDS)
    assert len(few) == 3 and len(whole) == len(train)
    np.testing.assert_array_equal(few.light[[0, -1]], whole.light[[0, -1]])
    np.testing.assert_array_equal(few.poses[[0, -1]], whole.poses[[0, -1]])


def test_poses_are_those_in_the_middle_of_the_exposures(tiny):
    found = sharp_images(tiny, THRESHOLDS)
    np.testing.assert_allclose(found.poses, tiny.frame_pose(tiny.split.train), atol=1e-6)
    assert (found.near, found.far) == (tiny.near, tiny.far)


def test_projecting_undoes_looking_along_rays(tiny):
    found = sharp_images(tiny, THRESHOLDS)
    xy = np.random.default_rng(0).uniform(0, 16, (20, 2))
    depth = np.linspace(tiny.near, tiny.far, 20)
    ray = found.directions(xy, 1)
    points = found.poses[1, :, 3] + (depth / (ray @ found.poses[1, :, 2]))[:, None] * ray
    there, seen = found.project(points, 1)
    np.testing.assert_allclose(there, xy, atol=1e-4)
    np.testing.assert_allclose(seen, depth, rtol=1e-5)
    _, behind = found.project(2 * found.poses[1, :, 3] - points, 1)
    assert (behind == -1).all()


def test_borders_belong_to_the_image(tiny):
    found = sharp_images(tiny, THRESHOLDS)
    xy = np.array([[0.0, 0.0], [15.9, 15.9], [16.0, 3.0], [-0.1, 3.0]])
    assert found.inside(xy).tolist() == [True, True, False, False]
    np.testing.assert_array_equal(found.light_at(xy[:2], 0), found.light[0, [0, 15], [0, 15]])
