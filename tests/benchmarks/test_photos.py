"""Frames at a fraction of their size look at the same things."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.photos import downscaled
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.simulation.static_capture import Rig, Timing, simulate


@pytest.fixture(scope="module")
def recorded() -> Capture:
    timing = Timing(frames=2, exposure_us=10_000, interval_us=20_000, step_us=2_000, test_every=0)
    return simulate("tiles", rig=Rig((22, 16)), timing=timing).without(events=True)


def test_pixels_are_means_of_those_they_cover(recorded: Capture) -> None:
    small = downscaled(recorded, 3).needed_frames
    assert (small.width, small.height) == (7, 5)
    images = recorded.needed_frames.images
    block = images[1, 3:6, 6:9].reshape(9, -1).mean(0)
    np.testing.assert_allclose(small.images[1, 1, 2], block, atol=0.51)
    assert small.truth is not None and small.truth.shape == small.images.shape


def test_directions_stay_the_same(recorded: Capture) -> None:
    small = downscaled(recorded, 2).camera
    xy = torch.tensor([[3.0, 2.5], [9.5, 7.0]])
    torch.testing.assert_close(small.direction(xy), recorded.camera.direction(2 * xy))


def test_events_are_refused(recorded: Capture) -> None:
    timing = Timing(frames=2, exposure_us=10_000, interval_us=20_000, test_every=0)
    with pytest.raises(OptionError, match="smaller"):
        downscaled(simulate("tiles", rig=Rig((22, 16)), timing=timing), 2)
    with pytest.raises(OptionError, match="that small"):
        downscaled(replace(recorded), 40)
