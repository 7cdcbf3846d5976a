"""Time and memory of drawing Gaussians: the definition, naive tiles, our tiles, gsplat.

    python -m benchmarks.rasterize [--runs 10] [--threads 2]

Milliseconds forwards and backwards, best of the runs, and the peak of memory above what is held
between them; each contender runs in a process of its own. Gaussians are 1.5 px wide and half
opaque. The definition takes every Gaussian at every pixel, so it draws the smallest scene only.
With `--threads 1` times are CPU seconds, which other programs on the machine do not disturb. gsplat
runs where there is a CUDA device. Linux only, for the peak.
"""

import argparse
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from benchmarks import naive_tiles
from benchmarks.event_simulator import peak_mb
from benchmarks.ops import MEBI, resident_bytes
from benchmarks.table import Row, save, show
from sharpfield.core.camera import Camera
from sharpfield.core.errors import need
from sharpfield.ops._dispatch import using
from sharpfield.ops.rasterizer import Canvas, rasterize

Scene = tuple[int, tuple[int, int], float, int]
"""How many Gaussians, the size of the image, their scale in px, how many views."""

SCENES: dict[str, Scene] = {
    "500 at 100x75": (500, (100, 75), 1.5, 1),
    "5,000 at 200x133": (5_000, (200, 133), 1.5, 1),
    "30,000 at 346x260": (30_000, (346, 260), 1.5, 1),
    "30,000 at 346x260, 4 views": (30_000, (346, 260), 1.5, 4),
}
SMALLEST = "500 at 100x75"

DRAW: dict[str, Callable[..., Any]] = {
    "definition": rasterize.reference,
    "naive tiles": naive_tiles.rasterize,
    "tiles": rasterize,
    "gsplat": rasterize,
}


def scene(count: int, size: tuple[int, int], scale_px: float, views: int) -> list[Any]:
    """Gaussians all over an image, at depths of 2 to 4."""
    made, (width, height) = torch.Generator().manual_seed(0), size
    focal = 0.9 * width
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    depth = 2 + 2 * torch.rand(count, 1, generator=made)
    place = (torch.rand(count, 2, generator=made) - 0.5) * torch.tensor(size)
    uneven = torch.exp(0.3 * torch.randn(count, 3, generator=made))
    return [
        torch.cat([place * depth / focal, depth], 1),
        torch.randn(count, 4, generator=made),
        scale_px * depth / focal * uneven,
        0.05 + 0.9 * torch.rand(count, generator=made),
        torch.rand(views, count, 3, generator=made),
        torch.eye(3, 4).repeat(views, 1, 1),
        Canvas(camera, torch.zeros(views, 2, dtype=torch.int64), size),
    ]


def measure(version: str, name: str, threads: int, runs: int) -> Row:
    """A line of the table, without the ratio."""
    torch.set_num_threads(threads)
    device = "cuda" if version == "gsplat" else "cpu"
    *tensors, canvas = scene(*SCENES[name])
    leaves = [tensor.to(device).requires_grad_() for tensor in tensors]
    clock = time.thread_time if device == "cpu" and threads == 1 else time.perf_counter

    def now() -> float:
        if device == "cuda":
            torch.cuda.synchronize()
        return clock()

    def run() -> tuple[float, float]:
        for leaf in leaves:
            leaf.grad = None
        begin = now()
        drawn = DRAW[version](*leaves, canvas)
        forwards = now() - begin
        loss = drawn.light.sum() + drawn.depth.sum()
        begin = now()
        loss.backward()
        return forwards, now() - begin

    with using("auto"):
        run()  # compiles
        Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
        before = resident_bytes() / MEBI
        times = [run() for _ in range(runs)]
    on_device = device == "cuda"
    peak = torch.cuda.max_memory_allocated() / MEBI if on_device else peak_mb() - before
    forwards, backwards = (min(column) for column in zip(*times, strict=True))
    return {
        "scene": name,
        "version": version,
        "forwards (ms)": 1e3 * forwards,
        "backwards (ms)": 1e3 * backwards,
        "memory (MiB)": peak,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    versions = ["definition", "naive tiles", "tiles"]
    if torch.cuda.is_available():
        need("gsplat", extra="gpu", purpose="the benchmark of gsplat")
        versions.append("gsplat")
    rows: list[Row] = []
    for name in SCENES:
        found: dict[str, Row] = {}
        for version in versions:
            if version == "definition" and name != SMALLEST:
                continue
            with get_context("spawn").Pool(1) as alone:
                task = (version, name, options.threads, options.runs)
                found[version] = alone.apply(measure, task)
        naive = found["naive tiles"]
        rows += [{**row, "times faster": total(naive) / total(row)} for row in found.values()]
    show(rows)
    save("rasterize", rows, {"threads": options.threads})


def total(row: Row) -> float:
    return row["forwards (ms)"] + row["backwards (ms)"]


if __name__ == "__main__":
    main()
