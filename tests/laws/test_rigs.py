"""What must be true of any rig: events add up, stop at rest, and turn with time."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sharpfield.captures.native.layout import write
from sharpfield.captures.read import read_capture
from sharpfield.captures.writers import evdnerf as write_evdnerf
from sharpfield.events.index import build_index, signed_sum
from sharpfield.simulation.cameras.rigs import RING_FOCAL, ring
from sharpfield.simulation.moving_capture import simulate_moving
from sharpfield.simulation.scenes.moving import moving_scene
from sharpfield.simulation.scenes.static import Scene
from sharpfield.simulation.static_capture import Rig, Timing

RIG = Rig((24, 24), focal_of_width=RING_FOCAL)
TIMING = Timing(frames=5, exposure_us=0, interval_us=40_000, step_us=2_000, test_every=2)


@dataclass(frozen=True)
class Reversed:
    """A scene run backwards, about the middle of a recording."""

    scene: Scene

    def maps(self, time_s: float) -> list:
        return self.scene.bodies.maps(1e-6 * TIMING.span_us() - time_s)


@pytest.fixture(scope="module")
def capture():
    return simulate_moving("jelly", ring(3, held_out=1), rig=RIG, timing=TIMING)


def test_events_of_two_windows_add_up(capture):
    index = build_index(capture.needed_events)
    site, ends = np.arange(index.sites), (0, 71_003, 150_001)
    a, b, c = (np.full(index.sites, t) for t in ends)
    parts = signed_sum(index, site, a, b) + signed_sum(index, site, b, c)
    np.testing.assert_array_equal(parts, signed_sum(index, site, a, c))
    assert np.abs(parts).max() > 2


def test_a_scene_at_rest_makes_no_events():
    place = moving_scene("jelly")
    rest = replace(place, bodies=replace(place.bodies, maps=lambda t: place.bodies.maps(0.2)))
    made = simulate_moving(rest, ring(2), rig=RIG, timing=TIMING)
    assert len(made.needed_events) == 0 and np.abs(made.needed_frames.flow).max() < 1e-9


def test_reversed_time_turns_the_signs(capture):
    place = moving_scene("jelly")
    back = replace(place, bodies=replace(place.bodies, maps=Reversed(place).maps))
    made = simulate_moving(back, ring(3), rig=RIG, timing=TIMING)
    forth, back = (build_index(one.needed_events) for one in (capture, made))
    site = np.arange(forth.sites)
    ends = np.zeros(forth.sites, np.int64), np.full(forth.sites, TIMING.span_us() + 1)
    a, b = signed_sum(forth, site, *ends), signed_sum(back, site, *ends)
    # The first reference is the light at either end, so a count may differ by one.
    assert np.abs(a + b).max() <= 1 and np.abs(a).max() > 2


def test_both_layouts_hold_the_same_rig(capture, tmp_path):
    write(capture, tmp_path / "native")
    write_evdnerf.write(capture, tmp_path / "evdnerf")
    ours, theirs = read_capture(tmp_path / "native"), read_capture(tmp_path / "evdnerf")
    np.testing.assert_allclose(theirs.trajectory.poses, ours.trajectory.poses, atol=1e-9)
    np.testing.assert_array_equal(theirs.needed_frames.images, ours.needed_frames.images)
    np.testing.assert_array_equal(theirs.needed_frames.track, ours.needed_frames.track)
    for one, other in ((ours.events, theirs.events), (ours.test_events, theirs.test_events)):
        inside = one.window(10_000, 170_000)
        np.testing.assert_array_equal(np.bincount(inside.track), np.bincount(other.track))
