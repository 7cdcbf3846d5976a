import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.preparation.ingest.survey import EventFilter, hot_pixels, survey_events
from tests.streams import HEIGHT, WIDTH, random_events

SIZE = (WIDTH, HEIGHT)
ALWAYS = (0, 10**9)
NO_PIXELS = np.empty((0, 2), np.int64)


def pieces(events: EventStream, each: int) -> list[EventStream]:
    return [events[i : i + each] for i in range(0, len(events), each)]


@pytest.mark.parametrize("each", [1, 7, 3000])
def test_a_survey_counts_everything(each):
    events = random_events(3000)
    heard: list[int] = []
    found = survey_events(iter(pieces(events, each)), SIZE, "cam.raw", heard.append)
    assert found.count == heard[-1] == len(events)
    assert (found.first_us, found.last_us) == (events.t_us[0], events.t_us[-1])
    events_per_pixel = np.zeros((HEIGHT, WIDTH), np.int64)
    np.add.at(events_per_pixel, (events.y, events.x), 1)
    np.testing.assert_array_equal(found.events_per_pixel, events_per_pixel)
    counts = np.bincount((events.t_us - found.origin_us) // 1000)
    np.testing.assert_array_equal(found.events_per_ms, counts)


def test_a_recording_longer_than_a_day_has_the_wrong_unit():
    events = random_events(10, last_us=10**12)
    with pytest.raises(CaptureError, match="longer than a day") as caught:
        survey_events(iter([events]), SIZE, "cam.raw", lambda count: None)
    assert "unit" in str(caught.value)


# Hot pixels


def test_a_pixel_that_stands_out_is_hot():
    counts = np.random.default_rng(0).poisson(20, (40, 50))
    assert len(hot_pixels(counts, 10.0)) == 0
    counts[3, 7] = counts[39, 49] = 5000
    assert hot_pixels(counts, 10.0).tolist() == [[7, 3], [49, 39]]
    assert len(hot_pixels(counts, 0.0)) == 0


def test_two_side_by_side_are_both_hot():
    counts = np.full((20, 20), 5)
    counts[4, 4:6] = 4000
    assert hot_pixels(counts, 10.0).tolist() == [[4, 4], [5, 4]]


def test_an_edge_is_not_hot():
    counts = np.zeros((20, 20), np.int64)
    counts[:, 9:10] = 500  # a thin line that flickers
    counts[11, :] = 800
    assert len(hot_pixels(counts, 10.0)) == 0


def test_simulated_scenes_have_no_hot_pixels(samples):
    from sharpfield.recordings.open import open_recording
    from sharpfield.recordings.recording import ReaderOptions

    told = ReaderOptions(unit="ns", size=(300, 200))
    recording = open_recording(samples / "blender" / "atelier" / "events.h5", told)
    found = survey_events(recording.chunks(), (300, 200), "atelier", lambda count: None)
    assert len(hot_pixels(found.events_per_pixel, 10.0)) == 0


# What is taken out


def slow_lonely(events: EventStream, uncertainty_us: int) -> np.ndarray:
    """Which events are lonely, by looking at all earlier ones."""
    isolated = np.ones(len(events), bool)
    for i in range(len(events)):
        dx = np.abs(events.x[:i].astype(int) - int(events.x[i]))
        dy = np.abs(events.y[:i].astype(int) - int(events.y[i]))
        near = (np.maximum(dx, dy) == 1) & (events.t_us[i] - events.t_us[:i] <= uncertainty_us)
        isolated[i] = not near.any()
    return isolated


@pytest.mark.parametrize("each", [1, 13, 400])
def test_lonely_events_are_those_of_a_slow_search(each):
    events = random_events(400)
    sieve = EventFilter(NO_PIXELS, 2_000, ALWAYS, SIZE)
    kept = np.concatenate([sieve.filtered(part).t_us for part in pieces(events, each)])
    isolated = slow_lonely(events, 2_000)
    assert 0 < isolated.sum() < len(events)
    np.testing.assert_array_equal(kept, events.t_us[~isolated])
    assert sieve.isolated == isolated.sum()


def test_what_is_taken_out_is_counted():
    events = random_events(2000)
    sieve = EventFilter(np.array([[3, 4], [5, 6]]), 0, (20_000, 60_000), SIZE)
    kept = [sieve.filtered(part) for part in pieces(events, 64)]
    inside = (events.t_us >= 20_000) & (events.t_us <= 60_000)
    hot = ((events.x == 3) & (events.y == 4)) | ((events.x == 5) & (events.y == 6))
    assert sieve.outside == (~inside).sum()
    assert sieve.hot_pixel_events == (inside & hot).sum()
    np.testing.assert_array_equal(
        np.concatenate([part.t_us for part in kept]), events.t_us[inside & ~hot]
    )


def test_a_sieve_that_takes_nothing_copies_nothing():
    events = random_events(50)
    assert np.shares_memory(EventFilter(NO_PIXELS, 0, ALWAYS, SIZE).filtered(events).x, events.x)
