from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.frames import Exposure
from sharpfield.simulation.cameras.motions import exposure_for, instants, travel
from sharpfield.simulation.cameras.rigs import walk
from sharpfield.simulation.room_capture import BLURRY_OF_WIDTH, RoomTiming, simulate_room
from sharpfield.simulation.scenes.building import Paint, build, cylinder
from sharpfield.simulation.scenes.room_scene import CEILING, FLOOR, ROOM, room
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.static_capture import Rig, view

SMALL = Rig(size=(64, 48))
TINY = Rig(size=(32, 24))


@pytest.fixture(scope="module")
def walked() -> Capture:
    return simulate_room(rig=SMALL, timing=RoomTiming(frames=24), seed=1)


def test_the_wanted_share_is_blurred_and_held_out_frames_are_sharp(walked):
    blur, split = walked.frames.blur_px, walked.split
    share = (blur[split.train] >= BLURRY_OF_WIDTH * 64 * 0.99).mean()
    assert share == pytest.approx(0.75, abs=0.05)
    np.testing.assert_array_equal(split.test, [0, 8, 16])
    np.testing.assert_array_equal(blur[split.test], 0)
    np.testing.assert_array_equal(walked.frames.images[0], walked.frames.truth[0])
    assert len(np.unique(walked.frames.exposure.duration_us[split.train])) == 1


def test_frames_are_the_mean_of_light_while_the_shutter_is_open(walked):
    """The blurriest frame, against many images of its exposure."""
    frame = int(np.argmax(walked.frames.blur_px))
    times = np.linspace(*walked.frames.exposure.window(frame), 60).round().astype(np.int64)
    path, place = walk(walked.clock.span_us, 1), room()
    light = np.mean([view(place, walked.camera, p)[0] for p in path.poses(times)], 0)
    display = np.rint(255 * light ** (1 / 2.2))
    error = np.abs(display - walked.frames.images[frame])
    assert error.mean() < 0.6 and np.quantile(error, 0.99) < 5


def test_depth_is_where_the_surfaces_are(walked):
    """Points of all frames lie inside the room."""
    rays, frames = walked.depth.rays(), np.arange(len(walked.frames))
    for frame, pose in zip(frames, walked.frame_pose(frames).double().numpy(), strict=True):
        points = (rays * walked.depth.at(int(frame))[..., None]) @ pose[:, :3].T + pose[:, 3]
        low, high = points.reshape(-1, 3).min(0), points.reshape(-1, 3).max(0)
        assert (low > [-ROOM[0] / 2 - 0.01, CEILING - 0.01, -ROOM[1] / 2 - 0.01]).all()
        assert (high < [ROOM[0] / 2 + 0.01, FLOOR + 0.01, ROOM[1] / 2 + 0.01]).all()
        assert (walked.depth.at(int(frame)) > walked.near).all()
        assert (walked.depth.at(int(frame)) < walked.far).all()


def test_the_same_seed_gives_the_same_walk_and_another_another():
    timing = RoomTiming(frames=3)
    one, again, other = (simulate_room(rig=TINY, timing=timing, seed=s) for s in (2, 2, 3))
    np.testing.assert_array_equal(one.frames.images, again.frames.images)
    assert (one.frames.images != other.frames.images).mean() > 0.5
    longer = walk(3_000_000, 2).poses(np.array([0, 500_000]))
    np.testing.assert_allclose(walk(1_000_000, 2).poses(np.array([0, 500_000])), longer)


def test_published_blur_is_the_same_everywhere_and_spares_held_out_frames():
    timing = RoomTiming(frames=12, blur="published", blurry=1.0, train_every=3)
    made = simulate_room(rig=SMALL, timing=timing)
    np.testing.assert_array_equal(made.split.train, [0, 3, 6, 9])
    assert made.frames.exposure.instant.all()
    assert (made.frames.blur_px[made.split.train] > 0).all()
    same = (made.frames.images == made.frames.truth).all((1, 2, 3))
    np.testing.assert_array_equal(same, np.arange(12) % 3 != 0)


def test_an_event_camera_watches_if_asked():
    timing = RoomTiming(frames=6, events=True)
    made = simulate_room(rig=TINY, timing=timing)
    assert made.events is not None and len(made.events) > 1000
    assert made.known.thresholds.positive == 0.2
    assert simulate_room(rig=TINY, timing=replace(timing, events=False)).events is None


class Sliding:
    """A camera that slides sideways, one unit a second."""

    def poses(self, t_us):
        made = np.tile(np.eye(3, 4), (len(t_us), 1, 1))
        made[:, 0, 3] = 1e-6 * t_us
        return made


def test_travel_is_focal_length_times_shift_over_depth():
    camera = Camera(16, 12, 20.0, 20.0, 8.0, 6.0)
    depth = np.full((12, 16), 4.0, np.float32)
    np.testing.assert_allclose(travel(camera, Sliding(), depth, (0, 100_000)), 20 * 0.1 / 4)
    np.testing.assert_allclose(travel(camera, Sliding(), depth, (70, 70)), 0)


@pytest.mark.parametrize(("blurry", "expected"), [(0.0, 0), (0.5, 2), (0.75, 3), (1.0, 4)])
def test_an_exposure_blurs_the_share_that_was_asked_for(blurry, expected):
    speeds = np.array([10.0, 100.0, 40.0, 70.0])  # px per second
    found = exposure_for(
        lambda us: 1e-6 * us * speeds, blurry=blurry, blur_px=1.5, most_us=1_000_000
    )
    assert (1e-6 * found * speeds >= 1.5).sum() == expected
    short = exposure_for(lambda us: 1e-6 * us * speeds, blurry=1.0, blur_px=1.5, most_us=900)
    assert short == 900


def test_instants_hold_both_ends_and_the_middle():
    exposure = Exposure(np.array([100, 500]), np.array([301, 500]))
    np.testing.assert_array_equal(instants(exposure, 0, images=3), [100, 200, 301])
    np.testing.assert_array_equal(instants(exposure, 1, images=9), [500])


def test_a_cylinder_is_where_geometry_says():
    """Depth of its side and of its lid, against closed forms."""
    part = cylinder((0, 0, 4.0), 1.0, 2.0, Paint("#808080"))
    scene = Scene("test", build([part], ambient=1.0), 0.5, 20.0)
    camera = Camera(65, 49, 60.0, 60.0, 32.5, 24.5)
    _, depth = view(scene, camera, np.eye(3, 4))
    rays = camera.direction(camera.grid().double())
    rays = (rays / rays[..., 2:]).numpy()
    x, y = rays[..., 0], rays[..., 1]
    a, b, c = 1 + x * x, -4.0, 15.0
    with np.errstate(invalid="ignore"):
        side = (-b - np.sqrt(b * b - a * c)) / a
        inside = np.abs(side * y) < 0.97
    np.testing.assert_allclose(depth[inside], side[inside], rtol=1e-5)
    assert inside.sum() > 400
    above = np.eye(3, 4)
    above[:, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks down: +y
    above[:, 3] = [0, -4, 4]
    rgb, lid = view(scene, camera, above)
    assert lid[24, 32] == pytest.approx(3.0, abs=1e-5)
    covered = np.hypot(*(np.moveaxis(rays[..., :2], -1, 0) * 3)) < 0.95
    np.testing.assert_allclose(lid[covered], 3.0, rtol=1e-5)
    assert torch.from_numpy(rgb).isfinite().all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"frames": 1}, "a walk needs two frames"),
        ({"blurry": 1.2}, "share of blurry frames lies between 0 and 1"),
        ({"exposure_us": 200_000}, "exposures would overlap"),
    ],
)
def test_impossible_walks(wrong, message):
    with pytest.raises(OptionError, match=message):
        RoomTiming(**wrong)
