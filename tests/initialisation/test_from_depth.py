"""Depth cameras beside frame cameras, on a plane before both."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Split
from sharpfield.core.frames import DepthMaps, Exposure, Frames
from sharpfield.core.tone import tone_of
from sharpfield.geometry.trajectory import Still
from sharpfield.initialisation.static_scene import points_on_surfaces
from sharpfield.losses.photometric import relative_depth_error
from sharpfield.recipes.splat import RoomSplat
from sharpfield.sampling.view_measurements import MeasuredDepth

CAMERA = Camera(24, 16, 20.0, 20.0, 12.0, 8.0)
AWAY = 2.0


def wall(maps: Camera = CAMERA) -> Capture:
    """Three frames before a wall two units away, each a little further to the right."""
    poses = np.tile(np.eye(3, 4), (3, 1, 1))
    poses[:, 0, 3] = [0, 0.1, 0.2]
    at = np.arange(3) * 1000
    images = np.random.default_rng(0).integers(0, 256, (3, 16, 24, 3), dtype=np.uint8)
    stored = np.full((3, maps.height, maps.width), int(AWAY * 1000), np.uint16)
    return Capture(
        camera=CAMERA,
        trajectory=Still(poses),
        clock=Clock(0, 2001),
        near=1.0,
        far=4.0,
        frames=Frames(images, Exposure(at, at), np.arange(3), ("a", "b", "c")),
        depth=DepthMaps(stored, maps),
        split=Split(np.array([0, 2]), np.array([1])),
        known=Known(motion="unknown"),
    )


def test_each_pixel_has_the_depth_of_the_same_ray():
    half = Camera(12, 8, 10.0, 10.0, 6.0, 4.0)
    stored = np.arange(1, 97, dtype=np.uint16).reshape(1, 8, 12)
    found = MeasuredDepth(DepthMaps(stored, half, unit=1.0), CAMERA).at(0)
    assert np.array_equal(found, stored[0].repeat(2, 0).repeat(2, 1))


def test_what_the_depth_camera_does_not_see_is_unknown():
    narrow = Camera(6, 4, 20.0, 20.0, 3.0, 2.0)
    found = MeasuredDepth(DepthMaps(np.ones((1, 4, 6), np.uint16), narrow, unit=1.0), CAMERA).at(0)
    assert found.sum() == 24
    assert (found[6:10, 9:15] == 1).all()


def test_points_lie_on_the_wall_in_the_colours_of_learned_frames():
    capture = wall()
    start = points_on_surfaces(capture, tone_of("gamma2.2"), 500, torch.Generator().manual_seed(0))
    assert start.points.shape == (500, 3)
    assert np.allclose(start.points[:, 2], AWAY)
    held_out = capture.needed_frames.images[1].reshape(-1, 3)
    stored = np.rint(255 * tone_of("gamma2.2").encode(torch.from_numpy(start.colours)).numpy())
    learned = capture.needed_frames.images[[0, 2]].reshape(-1, 3)
    own = {tuple(colour) for colour in learned.tolist()}
    assert {tuple(colour) for colour in stored.astype(int).tolist()} <= own
    assert not own & {tuple(colour) for colour in held_out.tolist()}


def test_of_neighbours_the_better_frame_is_taken(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sharpfield.initialisation.static_scene.MAX_FRAMES", 1)
    start = points_on_surfaces(
        wall(),
        tone_of("gamma2.2"),
        100,
        torch.Generator().manual_seed(0),
        weights=np.array([0.1, 1.0]),
    )
    left = 0.2 - AWAY * 12 / 20
    assert start.points[:, 0].min() >= left


def test_depth_errors_are_relative_robust_and_only_of_known_pixels():
    drawn = torch.tensor([2.0, 1.0, 50.0, 3.0])
    measured = torch.tensor([2.0, 2.0, 1.0, 0.0])
    assert relative_depth_error(drawn, measured) == pytest.approx((0 + 0.5 + 1) / 3)
    assert relative_depth_error(drawn, torch.zeros(4)) == 0


def test_a_room_learns_its_depth():
    capture = wall()
    recipe = RoomSplat(steps=8)
    gaussians = replace(recipe.gaussians, cap_max=300, growth="none")
    sampling = replace(recipe.sampling, sharp_warmup=0.0, frame_quality="images")
    model = replace(recipe, gaussians=gaussians, sampling=sampling).build(capture, 0)
    terms = model.losses(model.draw(5), 5)
    assert 0 < float(terms["depth"].detach()) < 0.1
    assert float(terms["blur"].detach()) > 0
    terms["depth"].backward()
    assert model.scene.static.means.grad.abs().sum() > 0
