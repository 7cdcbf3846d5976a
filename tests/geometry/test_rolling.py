"""Where the camera is while an image is read row by row."""

from dataclasses import replace

import numpy as np
import torch

from sharpfield.core.capture import Capture
from sharpfield.geometry import se3
from sharpfield.geometry.rolling import KNOTS, Rolling, moved_rows
from sharpfield.simulation.sensors.frames import FrameSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate

DELAY_US = 400.0


def rolled() -> Capture:
    rig = Rig((12, 26), frame_sensor=FrameSensor(row_delay_us=DELAY_US))
    return simulate("tiles", "shaky", rig=rig, timing=Timing(frames=3, test_every=0), seed=1)


def test_rows_go_from_first_to_last_around_the_middle_one():
    capture = rolled()
    shutter, path = Rolling.of(capture), capture.trajectory
    assert np.isclose(shutter.readout * capture.clock.span_us, 25 * DELAY_US)
    time, track = torch.tensor([0.2, 0.6]), torch.zeros(2, dtype=torch.int64)
    rows, pose = shutter.rows(time, track), shutter.pose(time, track)
    assert rows is not None and rows.shape == (2, KNOTS, 3, 4)
    torch.testing.assert_close(rows[:, 0], path.pose(time, track))
    torch.testing.assert_close(rows[:, -1], path.pose(time + shutter.readout, track))
    torch.testing.assert_close(rows[:, KNOTS // 2], pose, atol=1e-5, rtol=1e-4)
    assert (rows[:, 0] - rows[:, -1]).abs().max() > 1e-3


def test_poses_of_frames_are_those_of_their_middle_row():
    capture = rolled()
    middle = torch.from_numpy(capture.clock.unit(capture.needed_frames.exposure.middle_us)).float()
    pose = Rolling.of(capture).pose(middle, torch.zeros(3, dtype=torch.int64))
    torch.testing.assert_close(capture.frame_pose(np.arange(3)), pose, atol=1e-5, rtol=1e-4)


def test_a_global_shutter_has_no_rows():
    capture = rolled()
    frames = capture.needed_frames
    exposure = replace(frames.exposure, row_delay_us=0.0)
    still = Rolling.of(replace(capture, frames=replace(frames, exposure=exposure)))
    time, track = torch.tensor(0.3), torch.tensor(0)
    assert still.readout == 0 and still.rows(time, track) is None
    assert torch.equal(still.pose(time, track), capture.trajectory.pose(time, track))
    assert moved_rows(None, torch.eye(3, 4), torch.eye(3, 4)) is None
    assert Rolling.of(capture.without(frames=True)).readout == 0


def test_rows_move_with_their_view():
    """Seen from the view's own pose they stay where they were."""
    capture, time, track = rolled(), torch.tensor(0.3), torch.tensor(0)
    shutter = Rolling.of(capture)
    rows, start = shutter.rows(time, track), shutter.pose(time, track)
    pose = se3.compose(se3.exp(torch.tensor([0.1, 0.2, -0.3, 1.0, 2.0, 3.0])), start)
    moved = moved_rows(rows, start, pose)
    assert rows is not None and moved is not None
    for before, after in zip(rows, moved, strict=True):
        relative = [se3.compose(se3.inverse(a), b) for a, b in ((start, before), (pose, after))]
        torch.testing.assert_close(*relative, atol=2e-6, rtol=1e-4)
