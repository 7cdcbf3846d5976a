"""Neighbours among points on the surfaces of a room: time and memory as points become more.

    python -m benchmarks.neighbours [--points 100000 1000000 5000000]

Contenders: our cells with the kernels of the CPU, the same cells with their definition in
plain torch, and scipy's cKDTree. Each looks for the 8 nearest within 4 voxels around 75 000 places
beside surfaces, a training step's worth; ours also walks 3136 rays of 400 places through the room.
Seconds are of the CPU, on one core; memory is what each adds to a fresh process that holds
the points, while it prepares and at its peak. Linux only, for the peak.
"""

import argparse
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

ROOM = np.array([8.0, 3.0, 6.0])
QUERIES, NEAREST = 75_000, 8
RAYS, PLACES, ASKED = 3136, 400, 24
PLAIN_QUERIES = 5_000
"""Of the definition, whose time is then scaled up."""


def surfaces(count: int) -> np.ndarray:
    """Points on the six sides of the room, a little rough."""
    random = np.random.default_rng(0)
    area = np.array([ROOM[1] * ROOM[2], ROOM[0] * ROOM[2], ROOM[0] * ROOM[1]])
    points = random.random((count, 3)) * ROOM
    side = random.choice(3, count, p=area / area.sum())
    points[np.arange(count), side] = ROOM[side] * random.integers(0, 2, count)
    return (points + random.normal(0, 0.002, points.shape)).astype(np.float32)


def voxel(count: int) -> float:
    """0.8 of the distance between points, as recipes take."""
    total = 2 * (ROOM[0] * ROOM[1] + ROOM[1] * ROOM[2] + ROOM[0] * ROOM[2])
    return 0.8 * float(np.sqrt(total / count))


def beside(points: np.ndarray, size: float) -> np.ndarray:
    random = np.random.default_rng(1)
    row = random.integers(0, len(points), QUERIES)
    return (points[row] + random.normal(0, 1.5 * size, (QUERIES, 3))).astype(np.float32)


def measure(contender: str, count: int) -> dict[str, float]:
    """Seconds and megabytes of one contender."""
    torch.set_num_threads(1)
    points = surfaces(count)
    size = voxel(count)
    return {"ours": ours, "plain": plain, "tree": tree}[contender](points, size)


def ours(points: np.ndarray, size: float) -> dict[str, float]:
    from sharpfield.ops.knn import first_near, neighbours, sort_into_cells

    given, queries = torch.from_numpy(points), torch.from_numpy(beside(points, size))
    few = sort_into_cells(given[:1000], 2 * size)
    rays = seen_from_the_middle()
    neighbours(queries[:10], given[:1000], few, NEAREST, 4 * size)  # compiles
    first_near(*(part[:2] for part in rays), few, ASKED)
    start = forget_peak()
    prepare, cells = timed(lambda: sort_into_cells(given, 2 * size))
    held = now_mb() - start
    query, _ = timed(lambda: neighbours(queries, given, cells, NEAREST, 4 * size))
    march, _ = timed(lambda: first_near(*rays, cells, ASKED))
    return {"prepare": prepare, "query": query, "march": march} | memory(start, held)


def plain(points: np.ndarray, size: float) -> dict[str, float]:
    from sharpfield.ops._dispatch import using
    from sharpfield.ops.knn import neighbours, sort_into_cells

    given = torch.from_numpy(points)
    queries = torch.from_numpy(beside(points, size))[:PLAIN_QUERIES]
    start = forget_peak()
    prepare, cells = timed(lambda: sort_into_cells(given, 2 * size))
    held = now_mb() - start
    with using("reference"):
        query, _ = timed(lambda: neighbours(queries, given, cells, NEAREST, 4 * size))
    return {"prepare": prepare, "query": query * QUERIES / PLAIN_QUERIES} | memory(start, held)


def tree(points: np.ndarray, size: float) -> dict[str, float]:
    from scipy.spatial import cKDTree

    queries = beside(points, size)
    start = forget_peak()
    prepare, made = timed(lambda: cKDTree(points))
    held = now_mb() - start
    query, _ = timed(lambda: made.query(queries, NEAREST, distance_upper_bound=4 * size))
    return {"prepare": prepare, "query": query} | memory(start, held)


def seen_from_the_middle() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    made = torch.Generator().manual_seed(2)
    direction = torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=made), dim=-1)
    origin = torch.from_numpy((ROOM / 2).astype(np.float32)).expand(RAYS, 3).contiguous()
    return origin, direction, torch.linspace(0.1, 8, PLACES).expand(RAYS, -1).contiguous()


def timed(work: Callable[[], object]) -> tuple[float, object]:
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def memory(start: float, held: float) -> dict[str, float]:
    status = Path("/proc/self/status").read_text()
    peak = int(status.split("VmHWM:")[1].split()[0]) / 1024
    return {"held": held, "peak": peak - start}


def forget_peak() -> float:
    Path("/proc/self/clear_refs").write_text("5")
    return now_mb()


def now_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[100_000, 1_000_000, 5_000_000])
    counts = parser.parse_args().points
    print(f"{QUERIES} queries for {NEAREST} neighbours, {RAYS} rays of {PLACES} places; one core")
    columns = ("prepare s", "query s", "us/query", "march s", "held MB", "peak MB")
    print(f"{'points':>10} {'':14}" + "".join(f"{name:>11}" for name in columns))
    for count in counts:
        for name, label in (
            ("ours", "cells, kernel"),
            ("plain", "cells, torch"),
            ("tree", "cKDTree"),
        ):
            with get_context("spawn").Pool(1) as alone:
                told = alone.apply(measure, (name, count))
            march = f"{told['march']:11.4f}" if "march" in told else f"{'':11}"
            print(
                f"{count:10,} {label:14}{told['prepare']:11.2f}{told['query']:11.3f}"
                f"{1e6 * told['query'] / QUERIES:11.2f}{march}{told['held']:11.0f}"
                f"{told['peak']:11.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
