"""The benchmark asks a raw file and a capture the same things."""

from pathlib import Path

import numpy as np

from benchmarks import ingest
from sharpfield.storage.event_writer import write_events
from sharpfield.storage.evt_writer import writing_evt
from tests.streams import random_events


def test_both_files_answer_alike(tmp_path: Path) -> None:
    events = random_events(3000, last_us=200_000)
    raw, capture = tmp_path / "a.raw", tmp_path / "a.h5"
    with writing_evt(raw, events[:0]) as writer:
        writer.append(events)
    write_events(capture, events)
    starts = [0, 50_000, 190_000, 300_000]
    found = ingest.windows(capture, starts)[1]
    assert found == ingest.raw_windows(raw, starts)[1]
    assert len(set(found)) == 4 and found[-1] == 0
    asked = np.array([[3, 4, 0, 300_000], [5, 2, 10_000, 90_000], [0, 0, 7, 8]])
    sums = ingest.pixels(capture, asked)[1]
    assert sums == ingest.raw_pixel(raw, asked)[1]
    ours = events.p[(events.x == 3) & (events.y == 4)].sum()
    assert sums[0] == ours != 0 and sums[2] == 0
