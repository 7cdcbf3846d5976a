"""How fast event cameras' files are read, and how much memory that takes.

    python -m benchmarks.decode [--events 8] [--runs 3] [--samples ../shared/data/prophesee]

Real recordings of Prophesee's sensors, repeated with time going on until there are that many
million events; EVT2.1 and DAT hold the events of the EVT2 recording. Each reader runs in a process
of its own. Speed is in million events per CPU second, the best of the runs, from a file that the
system has in memory to arrays in the order of time that are checked. Memory is the peak above that
before reading; readers that do not stream hold all events in the end.
"""

import argparse
import importlib.util
import os
import resource
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.plain_decode import PLAIN
from benchmarks.table import Row, save, show
from sharpfield.core.events import EventStream
from sharpfield.recordings.dat import open_dat
from sharpfield.recordings.evt import open_evt
from sharpfield.recordings.percent_header import read_header

HEADER = "% {name}\n% format {name};height={height};width={width}\n% Version 2\n"
HEADER += "% Width {width}\n% Height {height}\n% end\n"
MEBI = 2**20


def tiled(path: Path, out: Path, copies: int, *, word: str, kind_at: int, unit_us: int) -> int:
    """Repeat the words of a recording, times going on; how many events there are."""
    events = open_evt(path).load()
    ticks = int(events.t_us[-1]) // unit_us - int(events.t_us[0]) // unit_us + 1
    start = read_header(path).length
    words = np.fromfile(path, word, offset=start)
    mask = (1 << kind_at) - 1
    high = words >> kind_at == 8
    with out.open("wb") as file:
        file.write(path.read_bytes()[:start])
        for copy in range(copies):
            later = words.copy()
            later[high] = (8 << kind_at) | ((words[high] & mask) + copy * ticks & mask)
            file.write(later.tobytes())
    return copies * len(events)


def repacked(events: EventStream, folder: Path, copies: int) -> None:
    """The same events as EVT2.1 and as DAT."""
    span_us = int(events.t_us[-1] - events.t_us[0]) // 64 * 64 + 64
    x, y, bright = events.x.astype(np.int64), events.y.astype(np.int64), events.p > 0
    group = np.stack([events.t_us, y, bright, x >> 5])
    fresh = (np.diff(group, prepend=-1).any(0)) | (np.diff(x, prepend=0) <= 0)
    first = np.flatnonzero(fresh)
    masks = np.bitwise_or.reduceat(1 << (x & 31), first).astype(np.uint64)
    header = {"width": events.width, "height": events.height}
    with (folder / "EVT2.1.raw").open("wb") as packed, (folder / "DAT.dat").open("wb") as flat:
        packed.write(HEADER.format(name="EVT21", **header).encode())
        flat.write(HEADER.format(name="DAT", **header).encode().replace(b"% end\n", b"\x0c\x08"))
        for copy in range(copies):
            t = events.t_us + copy * span_us
            place = bright.astype(np.int64) << 28 | y << 14 | x
            flat.write(np.stack([t, place], -1).astype("<u4").tobytes())
            word = bright * 1 << 28 | (t & 63) << 22 | x >> 5 << 16 | y
            words = word[first].astype(np.uint64) << np.uint64(32) | masks
            high = (t[first] >> 6 | 8 << 28).astype(np.uint64) << np.uint64(32)
            new = np.flatnonzero(np.diff(high.astype(np.int64), prepend=0))
            packed.write(np.insert(words, new, high[new]).astype("<u8").tobytes())


def ours(path: Path) -> int:
    opened = (open_dat if path.suffix == ".dat" else open_evt)(path)
    return sum(len(part) for part in opened.chunks())


def plain(path: Path) -> int:
    kind = path.stem.removeprefix("short-")
    return len(PLAIN[kind](path.read_bytes()[read_header(path).length :])[2])


def faery(path: Path) -> int:
    reader = importlib.import_module("faery")
    return len(reader.events_stream_from_file(path).to_array())


READERS: dict[str, Callable[[Path], int]] = {"ours": ours, "numpy": plain, "faery": faery}


def measure(reader: str, path: Path, runs: int) -> tuple[float, float, int]:
    """Seconds, MiB and how many events were found."""
    READERS[reader](path.with_name(f"short-{path.name}"))  # compiles
    with open("/proc/self/statm") as file:
        before = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        found = READERS[reader](path)
        seconds.append(time.process_time() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    return min(seconds), peak / MEBI, found


def make(samples: Path, folder: Path, millions: float) -> None:
    """The files to read, and short ones like them."""
    for prefix, count in (("short-", 0.0), ("", 1e6 * millions)):
        with tempfile.TemporaryDirectory(dir=folder) as name:
            apart = Path(name)
            events = open_evt(samples / "evt2_sample.raw").load()
            copies = int(count / len(events)) + 1
            repacked(events, apart, copies)
            sample, out = samples / "evt2_sample.raw", apart / "EVT2.raw"
            tiled(sample, out, copies, word="<u4", kind_at=28, unit_us=64)
            sample, out = samples / "evt3_sample.raw", apart / "EVT3.raw"
            tiled(sample, out, int(count / 219_596) + 1, word="<u2", kind_at=12, unit_us=4096)
            for path in apart.iterdir():
                path.rename(folder / f"{prefix}{path.name}")


def main() -> None:
    """Run, print and save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=float, default=8.0, help="millions of events per file")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--samples", type=Path, default=Path("../shared/data/prophesee"))
    asked = parser.parse_args()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make(asked.samples, folder, asked.events)
        for path in (folder / f for f in ("EVT2.raw", "EVT2.1.raw", "EVT3.raw", "DAT.dat")):
            rows += _compared(path, asked.runs)
    show(rows)
    print(save("decode", rows, {"millions of events": asked.events}))


def _compared(path: Path, runs: int) -> list[Row]:
    """One file by each reader that knows it."""
    rows, seen = [], set()
    for reader in READERS:
        if reader == "faery" and not _faery_reads(path):
            continue
        with get_context("spawn").Pool(1) as pool:
            seconds, peak, found = pool.apply(measure, (reader, path, runs))
        seen.add(found)
        assert len(seen) == 1, f"{reader} finds other events in {path.stem}: {seen}"
        rows.append(
            {
                "format": path.stem,
                "reader": reader,
                "million events per s": found / seconds / 1e6,
                "memory (MiB)": peak,
                "bytes per event": path.stat().st_size / found,
            }
        )
    return rows


def _faery_reads(path: Path) -> bool:
    return importlib.util.find_spec("faery") is not None and path.stem != "EVT2.1"


if __name__ == "__main__":
    main()
