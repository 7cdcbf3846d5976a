"""A tiny moving capture: two cameras to learn from, one held out."""

from dataclasses import replace
from functools import cache

from sharpfield.core.capture import Capture
from sharpfield.simulation.cameras.rigs import ring
from sharpfield.simulation.moving_capture import MOVING_RIG, MOVING_TIMING, simulate_moving


@cache
def tiny_moving(exposure_us: int = 0) -> Capture:
    """16x16 pixels, five frames a camera, two cameras of four opposite each other."""
    timing = replace(
        MOVING_TIMING,
        frames=5,
        exposure_us=exposure_us,
        interval_us=40_000,
        step_us=5000,
        test_every=2,
    )
    rig = replace(MOVING_RIG, size=(16, 16))
    return simulate_moving("spinner", ring(3, held_out=1), rig=rig, timing=timing)
