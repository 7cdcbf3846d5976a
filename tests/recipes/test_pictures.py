import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.formation.threshold import FixedThresholds
from sharpfield.recipes.pictures import Pictures, sharp_pictures

THRESHOLDS = FixedThresholds(0.2, 0.2)
"""Of the simulation."""


def off(pictures: Pictures, capture: Capture) -> float:
    """Root mean square difference to what is known to be true."""
    truth = capture.needed_frames.truth[capture.split.train] / capture.needed_frames.white
    return float(np.sqrt(((pictures.values - truth) ** 2).mean()))


def test_events_make_them_sharp(tiny):
    sharp = sharp_pictures(tiny, THRESHOLDS)
    blurred = sharp_pictures(tiny.without(events=True), THRESHOLDS)
    assert off(sharp, tiny) < 0.8 * off(blurred, tiny)
    assert len(sharp) == len(tiny.split.train) and sharp.values.dtype == np.float32


def test_without_events_they_are_the_frames(tiny):
    found = sharp_pictures(tiny.without(events=True), THRESHOLDS)
    np.testing.assert_allclose(found.values * 255, tiny.frames.images[tiny.split.train], atol=1e-3)


def test_poses_are_those_in_the_middle_of_the_exposures(tiny):
    found = sharp_pictures(tiny, THRESHOLDS)
    np.testing.assert_allclose(found.poses, tiny.frame_pose(tiny.split.train), atol=1e-6)
    assert (found.near, found.far) == (tiny.near, tiny.far)


def test_projecting_undoes_looking_along_rays(tiny):
    found = sharp_pictures(tiny, THRESHOLDS)
    xy = np.random.default_rng(0).uniform(0, 16, (20, 2))
    depth = np.linspace(tiny.near, tiny.far, 20)
    ray = found.directions(xy, 1)
    points = found.poses[1, :, 3] + (depth / (ray @ found.poses[1, :, 2]))[:, None] * ray
    there, seen = found.project(points, 1)
    np.testing.assert_allclose(there, xy, atol=1e-9)
    np.testing.assert_allclose(seen, depth)
    _, behind = found.project(2 * found.poses[1, :, 3] - points, 1)
    assert (behind == -1).all()


def test_borders_belong_to_the_picture(tiny):
    found = sharp_pictures(tiny, THRESHOLDS)
    xy = np.array([[0.0, 0.0], [15.9, 15.9], [16.0, 3.0], [-0.1, 3.0]])
    assert found.inside(xy).tolist() == [True, True, False, False]
    np.testing.assert_array_equal(found.look(xy[:2], 0), found.values[0, [0, 15], [0, 15]])
