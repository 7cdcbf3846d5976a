"""Scores of held-out event cameras: the true scene is nearly perfect, nothing is the floor."""

from dataclasses import replace

import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Radiance, Rays
from sharpfield.evaluation.event_scores import score_events
from sharpfield.simulation.scenes.moving import moving_scene
from tests.evaluation.fake import Sky
from tests.recipes.moving import tiny_moving


class Scene(Sky):
    """What a perfect model would render: the scene itself, or a part of its contrast."""

    def __init__(self, capture: Capture, contrast: float) -> None:
        super().__init__(capture)
        self.contrast = contrast

    def render(self, rays: Rays) -> Radiance:
        """Traced, all at one time."""
        place = moving_scene(self.capture.name)
        time_us = float(self.capture.clock.us(float(rays.time[0])))
        origin, direction = rays.origin.double().numpy(), rays.direction.double().numpy()
        footprint = 1 / self.capture.camera.fx_px
        seen, _ = place.light(origin, direction, time_us * 1e-6, footprint_rad=footprint)
        light = torch.from_numpy(seen).clamp_min(1e-5) ** self.contrast
        none = torch.zeros(len(light))
        return Radiance(light, none, none, rays.weight)


def scores(contrast: float, **change) -> dict[str, float]:
    capture = replace(tiny_moving(), **change)
    found = score_events(Scene(capture, contrast), capture, windows=2, lengths=(1 / 4,))
    assert found is not None
    return found["lengths"]["0.25"]


def test_predicting_nothing_is_the_floor():
    nothing = scores(0.0)
    assert nothing["event_psnr"] == pytest.approx(nothing["none_psnr"])
    assert nothing["count_psnr"] == pytest.approx(nothing["none_count_psnr"])
    assert nothing["event_f1"] == 0
    assert nothing["count_mae_silent"] == 0


def test_the_true_scene_is_far_above_the_floor():
    true, half = scores(1.0), scores(0.5)
    assert true["event_psnr"] > true["none_psnr"] + 6
    assert true["event_psnr"] > half["event_psnr"] > half["none_psnr"]
    assert true["count_mae_silent"] < 1
    assert true["event_f1"] > 0.7


def test_without_held_out_events_there_are_no_scores():
    capture = replace(tiny_moving(), test_events=None)
    assert score_events(Scene(capture, 1.0), capture) is None
