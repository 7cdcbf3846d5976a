"""What a long recording costs: to ingest, to take up again after a kill, and to look into.

    python -m benchmarks.ingest [--events 20000000] [--folder DIR] [--samples DIR]

A real recording of a Gen4.1 sensor is repeated, with time going on, until its EVT3 file holds that
many events. `sharpfield ingest` makes a capture of it; started anew, killed halfway, and started
again, it must leave the same bytes. Then both files are asked the same things, and must agree:

    window    all events of 10 ms, anywhere
    pixel     the sum of the polarities of a pixel between two times

A raw file has to be decoded from its beginning for either. The capture finds a window by bisection,
and a pixel through the index that training uses, which is made first. Memory is the peak of the
process that did the step, interpreter included. The folder needs about 30 bytes per event, which
are given back.
"""

import argparse
import hashlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import Row, save, show
from benchmarks.tiled import tiled
from sharpfield.events.index import signed_sum
from sharpfield.recordings.prophesee.evt import open_evt
from sharpfield.storage.disk_cache import cache_folder
from sharpfield.storage.event_cache import event_index, read_events
from sharpfield.storage.event_layouts import open_events

SAMPLE_EVENTS = 219_596
WINDOW_US = 10_000
KILLED_AFTER = 0.6
"""Of the time that ingesting takes."""

RAW_QUERIES, WINDOWS, QUERIES = 3, 30, 1_000_000
MEBI = 2**20

Answers = list[int]


def ingest(raw: Path, out: Path, kill_after: float | None = None) -> tuple[float, float]:
    """Seconds and MiB of the command; it is killed after so many seconds, if any are given."""
    command = [sys.executable, "-m", "sharpfield", "ingest", str(raw), "--out", str(out)]
    begin = time.perf_counter()
    # Repeating 9 ms of a street makes pixels look hot: all are kept, so that answers agree.
    process = subprocess.Popen([*command, "--hot", "0"], stdout=subprocess.DEVNULL)
    if kill_after is not None:
        time.sleep(kill_after)
        assert process.poll() is None, "it was done before it was killed: take more events"
        process.send_signal(signal.SIGKILL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert kill_after is not None or process.returncode == 0, "it failed"
    return time.perf_counter() - begin, used.ru_maxrss * 1024 / MEBI


def raw_windows(path: Path, starts: Answers) -> tuple[list[float], Answers]:
    """Seconds for each window of a raw file, and the times and places of its events, summed."""
    seconds, found = [], []
    for start in starts:
        begin, total = time.perf_counter(), 0
        for chunk in open_evt(path).chunks():
            total += _sum(chunk.window(start, start + WINDOW_US))
            if chunk.t_us[-1] >= start + WINDOW_US:
                break
        seconds.append(time.perf_counter() - begin)
        found.append(total)
    return seconds, found


def windows(path: Path, starts: Answers) -> tuple[list[float], Answers]:
    """The same of a capture."""
    seconds, found = [], []
    with open_events(path) as file:
        for start in starts:
            begin = time.perf_counter()
            part = file.window(start, start + WINDOW_US)
            seconds.append(time.perf_counter() - begin)
            found.append(_sum(part))
    return seconds, found


def raw_pixel(path: Path, asked: np.ndarray) -> tuple[list[float], Answers]:
    """Seconds for one pixel of a raw file after the other, and the sums."""
    seconds, found = [], []
    for x, y, start, end in asked.tolist():
        begin, total = time.perf_counter(), 0
        for chunk in open_evt(path).chunks():
            part = chunk.window(start, end)
            total += int(part.p[(part.x == x) & (part.y == y)].sum())
            if chunk.t_us[-1] >= end:
                break
        seconds.append(time.perf_counter() - begin)
        found.append(total)
    return seconds, found


def make_index(path: Path) -> tuple[list[float], Answers]:
    """Seconds that the index takes, with the columns that it sorts."""
    begin = time.perf_counter()
    with open_events(path) as file:
        event_index(read_events(file, in_memory=0))
    return [time.perf_counter() - begin], []


def pixels(path: Path, asked: np.ndarray) -> tuple[list[float], Answers]:
    """Seconds for each of many pixels of a capture, asked together, and the sums."""
    with open_events(path) as file:
        index, width = event_index(read_events(file, in_memory=0)), file.part(0, 0).width
    x, y, start, end = asked.T
    signed_sum(index, (y * width + x)[:1], start[:1], end[:1])  # compiles
    begin = time.perf_counter()
    found = signed_sum(index, y * width + x, start, end)
    return [(time.perf_counter() - begin) / len(asked)], found.tolist()


def apart(step: Callable[..., Any], *given: Any) -> tuple[list[float], float, Answers]:
    """Seconds, MiB and answers of a step in a process of its own."""
    with get_context("spawn").Pool(1) as pool:
        (seconds, found), peak = pool.apply(_measured, (step, *given))
    return seconds, peak, found


def _measured(step: Callable[..., Any], *given: Any) -> tuple[Any, float]:
    return step(*given), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MEBI


def _sum(events: Any) -> int:
    """Something that two equal windows share, and two different ones hardly do."""
    weights = (events.x.astype(np.int64), events.y.astype(np.int64) << 11, events.p << 3)
    return len(events) + int(events.t_us.sum()) + sum(int(weight.sum()) for weight in weights)


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument(
        "--folder", type=Path, help="where there is room; by default that for temporary files"
    )
    parser.add_argument("--samples", type=Path, default=Path("../shared/data/prophesee"))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=asked.folder, prefix="ingest-") as name:
        raw = Path(name) / "big.raw"
        sample, copies = asked.samples / "evt3_sample.raw", -(-asked.events // SAMPLE_EVENTS)
        count = tiled(sample, raw, copies, word="<u2", kind_at=12, unit_us=4096)
        rows = [*_ingested(raw), *_looked_into(raw, raw.with_name("capture") / "events.h5")]
    show(rows)
    print(save("ingest", rows, {"events": count}))


def _ingested(raw: Path) -> list[Row]:
    """The capture and another one, on whose way it was killed; and that they are the same."""
    out, again = raw.with_name("capture"), raw.with_name("again")
    seconds, peak = ingest(raw, out)
    killed, _ = ingest(raw, again, KILLED_AFTER * seconds)
    resumed, peak_again = ingest(raw, again)
    sums = {_digest(folder / "events.h5") for folder in (out, again)}
    assert len(sums) == 1, "ingesting was killed, and left other bytes than without"
    size = (out / "events.h5").stat().st_size
    return [
        _row("raw file", disk=raw.stat().st_size),
        _row("ingest", seconds, peak, size),
        _row(f"ingest again, killed after {killed:.0f} s", resumed, peak_again, size),
    ]


def _looked_into(raw: Path, events: Path) -> list[Row]:
    with open_events(events) as file:
        first, last = file.span_us()
        width, height = file.part(0, 0).width, file.part(0, 0).height
    draw = np.random.default_rng(0)
    starts = draw.integers(first, last - WINDOW_US, WINDOWS).tolist()
    spans = np.sort(draw.integers(first, last, (QUERIES, 2)), axis=1)
    asked = np.column_stack(
        [draw.integers(0, width, QUERIES), draw.integers(0, height, QUERIES), spans]
    )
    before, before_peak, expected = apart(raw_windows, raw, starts[:RAW_QUERIES])
    after, after_peak, found = apart(windows, events, starts)
    assert found[:RAW_QUERIES] == expected, "windows of the two files differ"
    sums, sums_peak, expected = apart(raw_pixel, raw, asked[:RAW_QUERIES])
    made, made_peak, _ = apart(make_index, events)
    indexed, indexed_peak, found = apart(pixels, events, asked)
    assert found[:RAW_QUERIES] == expected, "sums of a pixel differ"
    cache = sum(file.stat().st_size for file in cache_folder(events).rglob("*.npy"))
    return [
        _row("10 ms, raw file", float(np.median(before)), before_peak),
        _row("10 ms, capture", float(np.median(after)), after_peak),
        _row("a pixel, raw file", float(np.median(sums)), sums_peak),
        _row("index by pixel", made[0], made_peak, cache),
        _row("a pixel, indexed", indexed[0], indexed_peak),
    ]


def _row(
    what: str, seconds: float | None = None, peak: float | None = None, disk: int | None = None
) -> Row:
    return {
        "what": what,
        "seconds": seconds,
        "memory (MiB)": peak,
        "disk (MiB)": None if disk is None else disk / MEBI,
    }


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


if __name__ == "__main__":
    main()
