"""The twin of an event camera, where every event can be told in advance."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Thresholds
from sharpfield.core.errors import OptionError, RunError
from sharpfield.core.events import EventStream
from sharpfield.core.rays import Radiance, Rays, Views
from sharpfield.geometry.normalise import moved, normalised
from sharpfield.geometry.space import Similarity
from sharpfield.geometry.trajectory import LearnedKnots, Stamped, Still
from sharpfield.simulation.sensors.event_pixels import SENSORS, EventSensor
from sharpfield.twin.event_twin import (
    EventTwin,
    TimeSteps,
    light_of,
    path_viewpoint,
    resized_camera,
    stated_sensor,
    track_viewpoint,
)
from tests.evaluation.fake import CAMERA, Sky, capture

CLOCK = Clock(0, 100_000)
SLOPE = 6.0
"""Of log light over the world's x, on a wall one unit ahead."""
SENSOR = EventSensor(threshold_on=0.25, threshold_off=0.2)
NOISY = replace(SENSOR, threshold_sigma=0.03, leak_hz=20.0, leak_jitter=0.2, shot_hz=30.0)


class Wall(Sky):
    """A wall, one unit ahead of the origin, whose light is exp(SLOPE x) in the capture's world."""

    def render(self, rays: Rays) -> Radiance:
        x, z = (rays.origin[..., i] for i in (0, 2))
        across = x + (1 - z) * rays.direction[..., 0] / rays.direction[..., 2]
        light = (SLOPE * across - 1).exp()
        ones = torch.ones_like(rays.time)
        return Radiance(light[..., None].expand(*light.shape, 3), ones, ones, rays.weight)


def no_events() -> EventStream:
    none = np.zeros(0, np.int16)
    return EventStream(none, none, np.zeros(0, np.int64), np.zeros(0, np.int8), 6, 5)


def sliding(metres: float = 0.5) -> Capture:
    """A camera that slides along x in 100 ms, and one that stands still."""
    poses = np.tile(np.eye(3, 4), (2, 1, 1))
    poses[1, 0, 3] = metres
    path = Stamped(np.array([0, 100_000]), poses, CLOCK)
    return Capture(Camera(6, 5, 40.0, 40.0, 3.0, 2.5), path, CLOCK, 0.5, 2.0, events=no_events())


def twin(made: Capture, sensor: EventSensor = SENSOR, **options: int) -> EventTwin:
    model = Wall(made)
    seat = track_viewpoint(model, made, 0)
    return EventTwin(light_of(model, seat), seat.span_us, sensor, **options)


def all_of(made: EventTwin) -> EventStream:
    return made.until(made.span_us[1] + 1)


def expect_same(a: EventStream, b: EventStream) -> None:
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)


def test_a_ramp_that_slides_by_is_crossed_when_it_should_be():
    """Log light grows by 3 in 100 ms: every pixel passes a threshold of 0.25 each 8.33 ms."""
    events = all_of(twin(sliding()))
    times = np.rint(np.arange(1, 12) * 0.25 / (SLOPE * 0.5) * 100_000)
    assert set(events.p) == {1}
    for x in range(6):
        for y in range(5):
            own = events.t_us[(events.x == x) & (events.y == y)]
            np.testing.assert_allclose(own[:11], times, atol=25)  # float32 light, darker left
    assert 11 * 30 <= len(events) <= 12 * 30  # the twelfth is at the very end


@pytest.mark.parametrize("sensor", [SENSOR, NOISY, replace(NOISY, cutoff_hz=300.0)])
@pytest.mark.parametrize(
    "cuts", [(40_000,), (8_333, 8_334, 50_001), tuple(range(777, 99_999, 777))]
)
def test_windows_add_up_to_the_whole_event_by_event(sensor: EventSensor, cuts: tuple[int, ...]):
    whole, cut = all_of(twin(sliding(), sensor)), twin(sliding(), sensor)
    parts = [cut.until(t) for t in (*cuts, 100_001)]
    for part, end in zip(parts, cuts, strict=False):
        assert not len(part) or part.t_us[-1] < end
    assert len(whole) > 300
    together = replace(whole, **{
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("x", "y", "t_us", "p")
    })  # fmt: skip
    expect_same(whole, together)


def test_the_same_seed_gives_the_same_events_and_another_gives_others():
    a, b, c = (all_of(twin(sliding(), NOISY, seed=seed)) for seed in (3, 3, 4))
    expect_same(a, b)
    assert len(a) != len(c) or (a.t_us != c.t_us).any()


def test_nothing_happens_before_a_camera_and_a_scene_that_stand_still():
    made = sliding(0.0)
    still = twin(made)
    assert len(all_of(still)) == 0
    assert still.rendered == 1 + 25  # steps of 4 ms, none of them halved


def test_a_scene_that_changes_is_seen_by_a_camera_that_stands_still():
    class Dawn(Wall):
        def render(self, rays: Rays) -> Radiance:
            seen = super().render(rays)
            return replace(seen, rgb=seen.rgb * (2 * rays.time[..., None]).exp())

    own = replace(sliding(), trajectory=Still(np.eye(3, 4)[None]))
    seat = track_viewpoint(Dawn(own), own, 0)
    events = EventTwin(light_of(Dawn(own), seat), seat.span_us, SENSOR).until(99_000)
    assert len(events) == 30 * 7 and set(events.p) == {1}  # at 12.5, 25, ..., 87.5 ms
    np.testing.assert_allclose(events.t_us[::30], np.arange(1, 8) * 12_500, atol=5)


def test_going_back_darkens_what_going_forth_brightened():
    forth, back = (
        all_of(twin(sliding(x), replace(SENSOR, threshold_off=0.25))) for x in (0.5, -0.5)
    )
    assert len(forth) == pytest.approx(len(back), abs=30)
    assert set(forth.p) == {1} and set(back.p) == {-1}


def test_reversed_time_flips_signs_and_keeps_times():
    """From a little above level 11 back to level 0, each level between is crossed again."""
    sensor = replace(SENSOR, threshold_on=0.25, threshold_off=0.25)
    forward = light_of(Wall(sliding()), track_viewpoint(Wall(sliding()), sliding(), 0))
    end = 91_690  # level 11 is passed at 91_667

    def backward(t_us: int) -> np.ndarray:
        return forward(end - t_us)

    ahead, back = (EventTwin(draw, (0, end), sensor).until(end + 1) for draw in (forward, backward))
    assert set(ahead.p) == {1} and set(back.p) == {-1}
    assert len(ahead) == len(back) == 11 * 30
    here, there = ((part.x == 3) & (part.y == 2) for part in (ahead, back))
    mirrored = np.sort(end - back.t_us[there])
    np.testing.assert_allclose(mirrored[1:], ahead.t_us[here][:-1], atol=40)


def test_counts_of_a_window_are_the_change_of_light_in_it():
    """The published event frame, but for what a pixel carries over: less than a threshold."""
    draw = light_of(Wall(sliding()), track_viewpoint(Wall(sliding()), sliding(), 0))
    made = twin(sliding())
    made.until(23_000)
    part = made.until(61_000)
    counted = np.zeros((5, 6))
    np.add.at(counted, (part.y, part.x), np.where(part.p > 0, 0.25, -0.2))
    change = np.log((draw(61_000) / draw(23_000)).mean(-1))
    assert np.abs(counted - change).max() < 0.25
    assert counted.mean() == pytest.approx(change.mean(), abs=0.13)


def test_a_pixel_gathers_light_over_its_area():
    """Of light exp(SLOPE x) over a pixel 1/40 wide, the mean is sinh(h)/h of the middle's."""
    seat = track_viewpoint(Wall(sliding()), sliding(), 0)
    whole = light_of(Wall(sliding()), seat, subpixels=16)(50_000)
    middle = light_of(Wall(sliding()), seat)(50_000)
    half = SLOPE / 40 / 2
    np.testing.assert_allclose(whole / middle, np.sinh(half) / half, rtol=1e-4)
    with pytest.raises(OptionError, match="at least one subpixel"):
        light_of(Wall(sliding()), seat, subpixels=0)


def test_scenes_of_gaussians_are_drawn_as_large_as_their_subpixels_ask():
    class Splats(Wall):
        sizes: ClassVar[list[tuple[int, int]]] = []

        def through(self, camera: Camera) -> "Splats":
            return self

        def draw_views(self, views: Views) -> Radiance:
            width, height = views.size
            self.sizes.append((width, height))
            light = torch.ones(1, height, width, 1)
            return Radiance(light[..., None].expand(1, height, width, 1, 3), light, light, light)

    seat = track_viewpoint(Splats(sliding()), sliding(), 0)
    for subpixels in (1, 3):
        assert light_of(Splats(sliding()), seat, subpixels=subpixels)(0).shape == (5, 6, 3)
    assert Splats.sizes == [(6, 5), (18, 15)]


def test_steps_are_halved_where_light_changes_much():
    """It changes by 0.03 a ms: 4 ms are less than 0.7 of 0.2, 2 ms than 0.5, 0.5 ms than 0.1."""
    looks = {
        most: twin(sliding(), time_steps=TimeSteps(most_change=most, shortest_us=1))
        for most in (0.7, 0.5, 0.1)
    }
    for made in looks.values():
        all_of(made)
    assert [made.rendered for made in looks.values()] == [26, 51, 201]


def test_events_come_only_from_within_the_span():
    model, made = Wall(sliding()), sliding()
    seat = track_viewpoint(model, made, 0).between(20_000, 60_000)
    part = EventTwin(light_of(model, seat), seat.span_us, SENSOR).until(60_000)
    assert 20_000 <= part.t_us[0] and part.t_us[-1] < 60_000
    first = part.t_us[(part.x == 3) & (part.y == 2)][0]
    assert first == pytest.approx(20_000 + 8_333, abs=5)  # switched on at 20 ms


def test_a_path_in_the_captures_world_is_brought_to_the_models():
    own = capture(events=0)
    change = Similarity(
        2.5, np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0], np.ones(3)
    )
    there = moved(own, change)
    there = replace(there, trajectory=LearnedKnots(there.trajectory, knots=4))
    given = path_viewpoint(Sky(there), own.trajectory.times_us, own.trajectory.poses)
    seat = track_viewpoint(Sky(there), own, 0)
    assert given.span_us == seat.span_us == (0, 1_000_000)
    a, b = (light_of(Sky(there), one)(430_000) for one in (given, seat))
    np.testing.assert_allclose(a, b, atol=1e-5)
    astray = path_viewpoint(Sky(own), own.trajectory.times_us, own.trajectory.poses)
    assert np.abs(light_of(Sky(there), astray)(430_000) - b).max() > 0.1


def test_the_world_of_a_normalised_capture_is_found():
    own = sliding()
    there, _ = normalised(own)
    seat = path_viewpoint(Wall(there), own.trajectory.times_us, own.trajectory.poses)
    zero = torch.tensor(0)
    np.testing.assert_allclose(
        seat.path.pose(torch.tensor(0.3), zero), there.trajectory.pose(torch.tensor(0.3), zero)
    )


def test_a_path_may_last_longer_than_the_capture():
    own = sliding()
    seat = path_viewpoint(Wall(own), own.trajectory.times_us * 3, own.trajectory.poses)
    events = EventTwin(light_of(Wall(own), seat), seat.span_us, SENSOR).until(300_000)
    first = events.t_us[(events.x == 3) & (events.y == 2)][0]
    assert first == pytest.approx(25_000, abs=5)


def test_a_colour_filter_passes_its_own_channel():
    def draw(t_us: int) -> np.ndarray:
        rgb = np.full((4, 4, 3), 0.1, np.float32)
        rgb[..., 0] *= np.exp(1e-5 * t_us)  # only red grows
        return rgb

    events = EventTwin(draw, (0, 100_000), replace(SENSOR, bayer="RGGB")).until(100_000)
    assert events.bayer == "RGGB"
    assert {(int(x) % 2, int(y) % 2) for x, y in zip(events.x, events.y, strict=True)} == {(0, 0)}


def test_light_in_one_channel_is_grey():
    def draw(t_us: int) -> np.ndarray:
        return np.full((3, 4, 1), 0.1 * np.exp(1e-5 * t_us), np.float32)

    events = EventTwin(draw, (0, 100_000), SENSOR).until(100_000)
    assert (events.width, events.height, len(events)) == (4, 3, 3 * 12)


def test_the_sensor_of_a_capture_is_what_it_states():
    known = Known(thresholds=Thresholds(0.2, 0.31), refractory_us=50.0, log_floor=1e-3)
    own = replace(sliding(), known=known)
    sensor = stated_sensor(own)
    assert (sensor.threshold_on, sensor.threshold_off) == (0.31, EventSensor().threshold_off)
    assert (sensor.refractory_us, sensor.floor, sensor.bayer) == (50.0, 1e-3, "")
    coloured = replace(own, events=replace(no_events(), bayer="GRBG"))
    assert stated_sensor(coloured).bayer == "GRBG"


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_reports(name: str):
    assert len(all_of(twin(sliding(), SENSORS[name]))) > 100


def test_other_pixels_see_the_same_middle():
    large = resized_camera(CAMERA, (80, 40))  # twice as large, and 24 rows less
    assert (large.size, large.fx_px, large.cx_px, large.cy_px) == ((80, 40), 60.0, 40.0, 20.0)
    centre = torch.tensor([[20.0, 16.0]])
    np.testing.assert_allclose(
        CAMERA.direction(centre), large.direction(torch.tensor([[40.0, 20.0]])), atol=1e-7
    )


def test_times_outside_the_path_are_refused():
    own = sliding()
    seat = track_viewpoint(Wall(own), own, 0)
    for start, end in ((0, 100_001), (50_000, 50_000), (-1, None)):
        with pytest.raises(OptionError, match="use times from 0 to 100 ms"):
            seat.between(start, end)


def test_a_view_that_is_not_there_is_refused():
    own = replace(sliding(), trajectory=Still(np.tile(np.eye(3, 4), (2, 1, 1))))
    with pytest.raises(OptionError, match="use a number from 0 to 1"):
        track_viewpoint(Wall(own), own, 2)
    assert track_viewpoint(Wall(own), own, 1).span_us == (0, 100_000)


def test_a_model_that_has_come_apart_is_noticed():
    class Broken(Wall):
        def render(self, rays: Rays) -> Radiance:
            return replace(super().render(rays), rgb=torch.full((*rays.time.shape, 3), torch.nan))

    own = sliding()
    with pytest.raises(RunError, match="not a finite number"):
        light_of(Broken(own), track_viewpoint(Broken(own), own, 0))(0)


def test_a_model_of_whole_views_without_lenses_keeps_its_own():
    class Whole(Wall):
        def draw_views(self, views: object) -> Radiance: ...

    own = sliding()
    seat = track_viewpoint(Whole(own), own, 0)
    with pytest.raises(OptionError, match="leave the size as it was recorded"):
        light_of(Whole(own), replace(seat, camera=resized_camera(own.camera, (12, 10))))
