"""Thresholds that fit a scene which is softer than the one that was recorded."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Thresholds
from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.rays import Radiance, Rays
from sharpfield.geometry.trajectory import Still
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.twin.agreement import MatchOptions, match_thresholds
from sharpfield.twin.event_twin import EventTwin, light_of, stated_sensor, track_viewpoint
from tests.evaluation.fake import Sky

CLOCK = Clock(0, 400_000)
SMALL = MatchOptions(windows=4, window_us=40_000, lead_us=20_000)


class Waves(Sky):
    """Light that goes up and down at each pixel, by so much in natural log."""

    def __init__(self, capture: Capture, contrast: float) -> None:
        super().__init__(capture)
        self.contrast = contrast

    def render(self, rays: Rays) -> Radiance:
        phase = 40 * rays.direction[..., 0] + 31 * rays.direction[..., 1] + 120 * rays.time
        light = 0.2 * (self.contrast * phase.sin()).exp()
        ones = torch.ones_like(rays.time)
        return Radiance(light[..., None].expand(*light.shape, 3), ones, ones, rays.weight)


def recorded(tracks: int = 1) -> Capture:
    """What still cameras recorded of waves of contrast 1.5."""
    none = np.zeros(0, np.int16)
    empty = EventStream(none, none, np.zeros(0, np.int64), np.zeros(0, np.int8), 12, 10)
    camera = Camera(12, 10, 20.0, 20.0, 6.0, 5.0)
    still = Still(np.tile(np.eye(3, 4), (tracks, 1, 1)))
    blank = Capture(camera, still, CLOCK, 0.5, 2.0, events=empty)
    truth = Waves(blank, 1.5)
    seat = track_viewpoint(truth, blank, 0)
    sensor = EventSensor(threshold_on=0.25, threshold_off=0.2)
    seen = EventTwin(light_of(truth, seat), seat.span_us, sensor).until(400_001)
    known = Known(thresholds=Thresholds(0.2, 0.25))
    return replace(blank, events=seen, known=known)


def test_the_true_scene_needs_no_other_thresholds():
    own = recorded()
    found = match_thresholds(Waves(own, 1.5), own, options=SMALL)
    assert found.on == pytest.approx(1, abs=0.02) and found.off == pytest.approx(1, abs=0.02)
    assert found.unmatched == pytest.approx(found.recorded, rel=0.02)


def test_a_softer_scene_is_matched_by_its_contrast_and_holds_elsewhere():
    own = recorded()
    soft = Waves(own, 0.9)
    span = (200_000, 300_000)
    found = match_thresholds(soft, own, options=SMALL, away_from=span)
    assert found.on == pytest.approx(0.6, abs=0.03) and found.off == pytest.approx(0.6, abs=0.03)
    assert found.unmatched < 0.7 * found.recorded
    sensor = found.applied(stated_sensor(own))
    assert sensor.threshold_on == pytest.approx(0.15, abs=0.01)
    twin = EventTwin(light_of(soft, track_viewpoint(soft, own, 0)), (0, 300_000), sensor)
    twin.until(span[0])
    held_out = own.events.window(*span)
    assert len(twin.until(span[1])) == pytest.approx(len(held_out), rel=0.03)


def test_as_much_is_looked_at_whatever_time_is_left_out():
    own = recorded()
    whole = match_thresholds(Waves(own, 1.5), own, options=SMALL).recorded
    for away in ((100_000, 300_000), (-5, 200_000), (80_000, 500_000)):
        found = match_thresholds(Waves(own, 1.5), own, options=SMALL, away_from=away).recorded
        assert found == pytest.approx(whole, rel=0.1)
    with_nothing_after = match_thresholds(
        Waves(own, 1.5), own, options=SMALL, away_from=(60_000, 400_000)
    )
    assert with_nothing_after.recorded > 0, "just as long as a lead and its window"


def test_every_camera_that_taught_has_its_windows():
    own = recorded(tracks=2)
    both = replace(own.events, track=(np.arange(len(own.events)) % 2).astype(np.uint8), tracks=2)
    found = match_thresholds(Waves(own, 1.5), replace(own, events=both), options=SMALL)
    whole = match_thresholds(Waves(own, 1.5), own, options=SMALL)
    assert found.recorded == pytest.approx(whole.recorded / 2, rel=0.05)  # each saw every other
    assert found.on > 1.3  # and so pixels of half the events take larger thresholds


def test_what_cannot_be_matched_is_refused():
    own = recorded()
    with pytest.raises(OptionError, match="no events to match"):
        match_thresholds(Waves(own, 1.5), replace(own, events=own.events[:0]), options=SMALL)
    with pytest.raises(OptionError, match="too far from the recorded"):
        match_thresholds(Waves(own, 0.01), own, options=SMALL)
    with pytest.raises(OptionError, match="nothing of the recording is left"):
        match_thresholds(Waves(own, 1.5), own, options=SMALL, away_from=(0, 400_000))
    early = replace(own, events=own.events[:5])
    with pytest.raises(OptionError, match="too little was recorded"):
        match_thresholds(Waves(own, 1.5), early, options=SMALL)
    with pytest.raises(OptionError, match="at least one window"):
        MatchOptions(windows=0)
