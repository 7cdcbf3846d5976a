"""How fast event cameras' files are read, and how much memory that takes.

    python -m benchmarks.decode [--events 8] [--runs 3] [--samples ../shared/data/prophesee]

Real recordings of Prophesee's sensors, repeated with time going on until there are that many
million events (see `benchmarks.tiled`). Each reader runs in a process of its own. Speed is in
million events per CPU second, the best of the runs, from a file that the system has in memory to
arrays in the order of time that are checked. Memory is the peak above that before reading; readers
that do not stream hold all events in the end.
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

from benchmarks.plain_decode import PLAIN, bag
from benchmarks.table import Row, save, show
from benchmarks.tiled import make
from sharpfield.recordings.open import open_recording
from sharpfield.recordings.prophesee.header import read_header

MEBI = 2**20


def ours(path: Path) -> int:
    return sum(len(part) for part in open_recording(path).chunks())


def plain(path: Path) -> int:
    if path.suffix not in RAW:
        return len(bag(path)[2])
    kind = path.stem.removeprefix("short-")
    return len(PLAIN[kind](path.read_bytes()[read_header(path).length :])[2])


def faery(path: Path) -> int:
    reader = importlib.import_module("faery")
    return len(reader.events_stream_from_file(path).to_array())


FILES = ("EVT2.raw", "EVT2.1.raw", "EVT3.raw", "DAT.dat", "ROS1.bag", "ROS2.mcap", "ROS2.db3")
RAW = (".raw", ".dat")

READERS: dict[str, Callable[[Path], int]] = {"ours": ours, "numpy": plain, "faery": faery}
READS = {
    "numpy": ("EVT2.raw", "EVT2.1.raw", "EVT3.raw", "DAT.dat", "ROS1.bag"),
    "faery": ("EVT2.raw", "EVT3.raw", "DAT.dat") if importlib.util.find_spec("faery") else (),
}
"""What others than ours can read."""


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
        for name in FILES:
            rows += _compared(folder / name, asked.runs)
    show(rows)
    print(save("decode", rows, {"millions of events": asked.events}))


def _compared(path: Path, runs: int) -> list[Row]:
    """One file by each reader that knows it."""
    rows, seen = [], set()
    for reader in READERS:
        if path.name not in READS.get(reader, FILES):
            continue
        with get_context("spawn").Pool(1) as pool:
            seconds, peak, found = pool.apply(measure, (reader, path, runs))
        seen.add(found)
        assert len(seen) == 1, f"{reader} finds other events in {path.stem}: {seen}"
        rows.append(
            {
                "format": path.stem if path.suffix in RAW else path.name,
                "reader": reader,
                "million events per s": found / seconds / 1e6,
                "memory (MiB)": peak,
                "bytes per event": path.stat().st_size / found,
            }
        )
    return rows


if __name__ == "__main__":
    main()
