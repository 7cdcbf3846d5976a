"""Time and memory of each op at the sizes of Ev-DeblurNeRF, plain torch against the fast version.

    python -m benchmarks.ops [--runs 5] [--threads 2] [--only WORD]

One row per op: forwards alone, forwards and backwards, and the peak of memory above the arguments.
A sixteenth of the paper's batch: 1152 rays of 128 fine samples. Each contender runs in a process of
its own, so that peaks do not mix; times are the best of the runs. Linux only, for the peak. With
`--threads 1` times are CPU seconds, which other programs on the machine do not disturb.
"""

import argparse
import os
import resource
import time
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from typing import Any

import torch
from torch import Tensor

from sharpfield.ops import compositing, grid, hash_grid
from sharpfield.ops._dispatch import Op, using

RAYS, SAMPLES = 1152, 128
COARSE, FINE = (376, 211, 210), (752, 423, 421)
CHANNELS = (64, 16, 16)
MEBI = 2**20


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def normal(*shape: int) -> Tensor:
    return torch.randn(shape, generator=generator())


def points_on_rays() -> Tensor:
    """Samples along rays that mostly run along z, as in normalised device coordinates."""
    random = generator()
    start = 1.9 * torch.rand(RAYS, 1, 2, generator=random) - 0.95
    slope = 0.05 * torch.randn(RAYS, 1, 2, generator=random)
    jitter = torch.rand(RAYS, SAMPLES, 1, generator=random)
    z = 2 * (torch.arange(SAMPLES)[:, None] + jitter) / SAMPLES - 1
    return torch.cat([start + slope * z, z], -1).reshape(-1, 3)


def volume(shape: tuple[int, int, int]) -> tuple[list[Tensor], list[Tensor]]:
    pairs = list(zip(grid.PAIRS, CHANNELS, strict=True))
    planes = [normal(shape[row], shape[column], c) for (column, row, _), c in pairs]
    return planes, [normal(shape[along], c) for (_, _, along), c in pairs]


def features(shape: tuple[int, int, int]) -> tuple[Any, ...]:
    return points_on_rays(), *volume(shape)


def mixture(shape: tuple[int, int, int]) -> tuple[Any, ...]:
    return *features(shape), normal(sum(CHANNELS), 32)


def hashed() -> tuple[Any, ...]:
    layout = hash_grid.hash_layout(levels=16, coarsest=16, growth=1.38, table_bits=19)
    return points_on_rays(), normal(sum(layout.entries), 2), layout


def rays() -> tuple[Any, ...]:
    shape = (RAYS, SAMPLES)
    return 40 * torch.rand(shape), torch.rand(shape) / SAMPLES


WORKLOADS: dict[str, tuple[Op[..., Any], Callable[[], tuple[Any, ...]]]] = {
    "features, coarse": (grid.plane_line_features, lambda: features(COARSE)),
    "features, fine": (grid.plane_line_features, lambda: features(FINE)),
    "mixture, coarse": (grid.plane_line_mixture, lambda: mixture(COARSE)),
    "mixture, fine": (grid.plane_line_mixture, lambda: mixture(FINE)),
    "total variation, fine": (
        grid.total_variation,
        lambda: (normal(FINE[1], FINE[0], CHANNELS[0]),),
    ),
    "hash grid": (hash_grid.hash_features, hashed),
    "weights": (compositing.weigh, rays),
}


def tables(value: Any) -> Iterator[Tensor]:
    """The tensors among the arguments whose gradient training needs: all but the points."""
    if isinstance(value, Tensor) and value.shape[-1] != 3:
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from tables(part)


def resident_bytes() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def measure(name: str, choice: str, threads: int, runs: int) -> tuple[float, float, int]:
    """Seconds forwards, seconds forwards and backwards, and bytes above the arguments."""
    torch.set_num_threads(threads)
    clock = time.thread_time if threads == 1 else time.perf_counter
    op, make = WORKLOADS[name]
    arguments = make()
    leaves = [table.requires_grad_() for table in tables(arguments)]

    def step() -> None:
        for leaf in leaves:
            leaf.grad = None
        found = op(*arguments)
        found.backward(torch.ones_like(found))

    def best(call: Callable[[], object]) -> float:
        seconds = []
        for _ in range(runs):
            start = clock()
            call()
            seconds.append(clock() - start)
        return min(seconds)

    with using(choice):
        step()  # compiles
        for leaf in leaves:
            leaf.grad = None
        before = resident_bytes()
        step()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
        with torch.no_grad():
            forwards = best(lambda: op(*arguments))
        return forwards, best(step), peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--only", default="", help="only the ops whose name contains this")
    options = parser.parse_args()
    print(f"{'op':24}{'version':11}{'forwards':>12}{'and back':>12}{'memory':>12}")
    for name in WORKLOADS:
        if options.only not in name:
            continue
        found = []
        for choice in ("reference", "fast"):
            with get_context("spawn").Pool(1) as pool:
                task = (name, choice, options.threads, options.runs)
                found.append(pool.apply(measure, task))
            forwards, step, peak = found[-1]
            times = f"{1e3 * forwards:9.1f} ms{1e3 * step:9.1f} ms"
            print(f"{name:24}{choice:11}{times}{peak / MEBI:8.0f} MiB", flush=True)
        ratios = [plain / fast for plain, fast in zip(*found, strict=True)]
        print(f"{'':24}{'':11}" + "".join(f"{ratio:11.1f}x" for ratio in ratios), flush=True)


if __name__ == "__main__":
    main()
