"""The benchmark compares readers that agree, on files that are what they claim."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.plain_decode import PLAIN, bag
from benchmarks.tiled import SINCE_US, bags, repacked, tiled
from sharpfield.recordings.open import open_recording
from sharpfield.recordings.prophesee.dat import open_dat
from sharpfield.recordings.prophesee.evt import open_evt
from sharpfield.recordings.prophesee.header import read_header
from sharpfield.storage.evt_writer import writing_evt
from tests.streams import random_events

COPIES = 3
TILING = {
    "EVT2": {"word": "<u4", "kind_at": 28, "unit_us": 64},
    "EVT3": {"word": "<u2", "kind_at": 12, "unit_us": 4096},
}


@pytest.mark.parametrize("kind", PLAIN)
def test_plain_readers_agree_with_ours(kind: str, tmp_path: Path) -> None:
    events = random_events(2000, last_us=40_000)
    path = tmp_path / f"{kind}.raw"
    if kind in TILING:
        sample = tmp_path / "sample.raw"
        with writing_evt(sample, events[:0], encoding=kind.lower()) as writer:
            writer.append(events)
        assert tiled(sample, path, COPIES, **TILING[kind]) == COPIES * len(events)
    else:
        repacked(events, tmp_path, COPIES)
        path = tmp_path / f"{kind}.{'dat' if kind == 'DAT' else 'raw'}"
    recording = (open_dat if kind == "DAT" else open_evt)(path)
    found = recording.load()
    x, y, t_us, bright = PLAIN[kind](path.read_bytes()[read_header(path).length :])
    assert len(found) == COPIES * len(events) and not str(recording.log)
    np.testing.assert_array_equal(found.t_us, t_us)
    np.testing.assert_array_equal(found.x[: len(events)], events.x)
    for ours, theirs in ((found.x, x), (found.y, y), (found.p > 0, bright)):
        np.testing.assert_array_equal(ours, theirs)


def test_bags_hold_the_same_events(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    events = random_events(2000, last_us=40_000)
    bags(events, tmp_path, COPIES)
    x, y, t_us, bright = bag(tmp_path / "ROS1.bag")
    np.testing.assert_array_equal(t_us[: len(events)], events.t_us + SINCE_US)
    for name in ("ROS1.bag", "ROS2.mcap", "ROS2.db3"):
        recording = open_recording(tmp_path / name)
        found = recording.load()
        assert recording.size == (events.width, events.height) and not str(recording.log)
        expected = (x, y, t_us, bright)
        for ours, theirs in zip((found.x, found.y, found.t_us, found.p > 0), expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)
