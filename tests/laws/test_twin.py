"""What must be true of a twin in a learned scene that moves, wherever its camera is."""

import numpy as np
import pytest
import torch

from sharpfield.report.event_frames import count_events
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.twin.event_twin import (
    EventTwin,
    TimeSteps,
    light_of,
    path_viewpoint,
    track_viewpoint,
)
from tests.recipes.moving import tiny_moving
from tests.recipes.test_evdnerf_physical import SMALL, learned

SENSOR = EventSensor(threshold_on=0.02, threshold_off=0.02)
SPAN = (0, 100_000)
TIME_STEPS = TimeSteps(step_us=10_000, most_change=1e9)
BACK = np.diag([-1.0, 1.0, -1.0])
"""Turns a camera round."""


@pytest.fixture(scope="module")
def model():
    return learned(SMALL, tiny_moving())


def pose_of(track: int) -> np.ndarray:
    own = tiny_moving().trajectory
    return own.pose(torch.tensor(0.0), torch.tensor(track)).double().numpy()


def twin(model, *poses: np.ndarray) -> EventTwin:
    """Of a camera that goes from pose to pose."""
    times = np.linspace(*SPAN, len(poses)).astype(np.int64)
    seat = path_viewpoint(model, times, np.stack(poses))
    return EventTwin(light_of(model, seat), SPAN, SENSOR, time_steps=TIME_STEPS)


def test_far_outside_the_rig_light_is_sound_and_what_misses_the_scene_is_silent(model):
    """No billboard at infinity: beyond the scene there is one light, at all times, everywhere."""
    near = pose_of(0)
    far = near.copy()
    far[:, 3] -= 40 * near[:, 2]  # the scene is less than a pixel wide
    seat = path_viewpoint(model, np.array(SPAN), np.stack([far, far]))
    views = [light_of(model, seat)(t) for t in SPAN]
    middle = (slice(6, 10), slice(6, 10))
    for view in views:
        assert np.isfinite(view).all() and view.max() <= 1
        around = view.copy()
        around[middle] = view[0, 0]
        np.testing.assert_array_equal(around, np.broadcast_to(view[0, 0], view.shape))
    counts = count_events(twin(model, far, far).until(SPAN[1])).sum(-1)
    counts[middle] = 0
    assert not counts.any()


def test_a_camera_that_turns_its_back_to_the_scene_sees_nothing_happen(model):
    near, other = pose_of(0), pose_of(1)
    away = [np.concatenate([pose[:, :3] @ BACK, pose[:, 3:]], 1) for pose in (near, other)]
    assert not len(twin(model, *away).until(SPAN[1]))
    assert len(twin(model, near, near).until(SPAN[1]))


def test_a_still_scene_makes_no_events_for_a_still_camera_and_some_for_a_moving_one(model):
    kept = [grid.clone() for grid in model.scene.field.moving]
    try:
        with torch.no_grad():
            for grid in model.scene.field.moving:
                grid.zero_()
        assert not len(twin(model, pose_of(0), pose_of(0)).until(SPAN[1]))
        assert len(twin(model, pose_of(0), pose_of(1)).until(SPAN[1]))
    finally:
        with torch.no_grad():
            for grid, values in zip(model.scene.field.moving, kept, strict=True):
                grid.copy_(values)


def test_windows_of_a_held_out_camera_add_up(model):
    seat = track_viewpoint(model, tiny_moving(), 3)

    def made() -> EventTwin:
        return EventTwin(light_of(model, seat), SPAN, SENSOR, time_steps=TIME_STEPS)

    whole, cut = made().until(SPAN[1]), made()
    parts = [cut.until(t) for t in (33_333, 33_334, 70_001, SPAN[1])]
    total = sum((count_events(part) for part in parts), np.zeros_like(count_events(whole)))
    np.testing.assert_array_equal(total, count_events(whole))
    assert len(whole) > 50
