from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Recording
from tests.recordings import fuzz
from tests.streams import random_events

ORIGINAL = bytes(range(256)) * 8


def opened(path: Path, events: EventStream) -> Recording:
    return Recording(path, "test", (events.width, events.height), lambda: iter([events]))


def test_damage_is_the_same_for_the_same_seed() -> None:
    for seed in range(50):
        copies = [fuzz.fuzzed(ORIGINAL, np.random.default_rng(seed)) for _ in range(2)]
        assert copies[0] == copies[1]


def test_nearly_every_copy_is_damaged() -> None:
    copies = {fuzz.fuzzed(ORIGINAL, np.random.default_rng(seed)) for seed in range(200)}
    assert len(copies) > 190
    assert len({len(copy) for copy in copies}) > 50


@pytest.mark.parametrize("wound", fuzz.WOUNDS)
def test_each_wound_bears_tiny_files(wound) -> None:
    for seed in range(50):
        generator = np.random.default_rng(seed)
        wound(np.arange(1, dtype=np.uint8), generator)


def test_sound_events_pass(tmp_path: Path) -> None:
    path = tmp_path / "events"
    path.write_bytes(ORIGINAL)
    assert fuzz.check(lambda path: opened(path, random_events(50)), path) == "whole"


def test_nonsense_is_caught(tmp_path: Path) -> None:
    path = tmp_path / "events"
    path.write_bytes(ORIGINAL[:10])
    with pytest.raises(AssertionError, match="500 events where 121 fit"):
        fuzz.check(lambda path: opened(path, random_events(500)), path)
    events = random_events(50)
    late = [events, events]
    with pytest.raises(AssertionError, match="time goes back"):
        fuzz.check(lambda path: Recording(path, "test", (12, 10), lambda: iter(late)), path)


def test_an_error_must_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "events"
    path.write_bytes(ORIGINAL)

    def refuse(path: Path) -> Recording:
        raise CaptureError("no recording", where="somewhere")

    with pytest.raises(AssertionError, match="no clear message"):
        fuzz.check(refuse, path)
