"""A tiny simulated capture for recipes to be built on."""

import pytest

from sharpfield.core.capture import Capture
from sharpfield.simulation import Rig, Timing, simulate


@pytest.fixture(scope="session")
def tiny() -> Capture:
    """16x16 pixels, six frames of which two are held out."""
    timing = Timing(frames=6, exposure_us=20_000, interval_us=24_000, test_every=4)
    return simulate("tiles", rig=Rig(size=(16, 16)), timing=timing, seed=3)
