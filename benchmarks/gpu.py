"""A training step and a view on a CUDA device at the paper's full size, and whether ops agree.

    python -m benchmarks.gpu [--runs 10] [--capture FOLDER]

Milliseconds per step and per 300x200 view by the device's own clock, after a warm-up; memory is
the most that torch held on the device. The contenders are those of `training_step`; heads compute
in float32 (without TF32) or bfloat16. A batch that does not fit is halved until it does.

Ops are run on their examples on the CPU and on the device; the largest difference of values
and gradients is told relative to the largest value.
"""

import argparse
import gc
import importlib
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.table import Row, save, show
from benchmarks.training_step import (
    ATELIER,
    GIB,
    OURS,
    PLAIN,
    Contender,
    built,
    captured,
    share,
    take_step,
)
from sharpfield import ops
from sharpfield.core.capture import Capture
from sharpfield.ops._dispatch import Op, registered
from sharpfield.rendering.view import render_view

WARM_UP = 3
WIDTH = 300


def milliseconds(run: Callable[[], object], runs: int) -> float:
    """Mean time of a run by the device's clock."""
    for _ in range(WARM_UP):
        run()
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    start.record()
    for _ in range(runs):
        run()
    end.record()
    torch.cuda.synchronize()
    return start.elapsed_time(end) / runs


def measure(contender: Contender, capture: Capture, parts: int, runs: int) -> Row:
    """A line of the table."""
    model, optimizer = built(contender, capture, parts, device="cuda")
    step = model.recipe.frames.blur_from - 1
    loss = sum(take_step(model, optimizer, step).values())
    torch.cuda.reset_peak_memory_stats()
    of_step = milliseconds(lambda: take_step(model, optimizer, step), runs)
    peak = torch.cuda.max_memory_allocated()

    camera = capture.camera.scaled(WIDTH / capture.camera.width)
    device = torch.device("cuda")
    middle, track = torch.tensor(0.5, device=device), torch.tensor(0, device=device)
    pose = model.frames.pinhole.trajectory.pose(middle, track)
    of_view = milliseconds(lambda: render_view(model.render, camera, pose, 0.5), 1)
    return {
        "contender": contender.name,
        "batch": share(parts),
        "step ms": of_step,
        "peak GiB": peak / GIB,
        "view ms": of_view,
        "loss": loss,
    }


def fitting(contender: Contender, capture: Capture, runs: int) -> Row:
    """A line for the largest part of the batch that fits."""
    parts = 1
    while True:
        try:
            return measure(contender, capture, parts, runs)
        except torch.cuda.OutOfMemoryError:
            print(f"{contender.name}: {share(parts)} of the batch does not fit", flush=True)
        # Outside the handler, whose exception would keep the tensors alive.
        parts *= 2
        gc.collect()
        torch.cuda.empty_cache()


def moved(value: Any, device: str, leaves: list[Tensor]) -> Any:
    """Arguments on a device; floating-point tensors want gradients and are noted in `leaves`."""
    if isinstance(value, Tensor):
        there = value.detach().to(device)
        if there.is_floating_point():
            leaves.append(there.requires_grad_())
        return there
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return type(value)(moved(part, device, leaves) for part in value)
    return value


def values_and_gradients(op: Op[..., Any], device: str) -> Iterator[Tensor]:
    """What an op makes of its example, and the gradients of all its arguments."""
    assert op.example is not None
    arguments = op.example(torch.Generator().manual_seed(1), 1)
    leaves: list[Tensor] = []
    found = op(*moved(arguments, device, leaves))
    found = [found] if isinstance(found, Tensor) else list(found)
    random = torch.Generator().manual_seed(2)
    weights = [torch.randn(value.shape, generator=random).to(device) for value in found]
    total = sum((value * weight).sum() for value, weight in zip(found, weights, strict=True))
    yield from found
    yield from torch.autograd.grad(total, leaves, materialize_grads=True)


def agreement() -> list[Row]:
    """Of each op, the largest relative difference between CPU and device."""
    for module in pkgutil.iter_modules(ops.__path__, "sharpfield.ops."):
        importlib.import_module(module.name)
    rows: list[Row] = []
    for name, op in registered().items():
        here, there = (list(values_and_gradients(op, device)) for device in ("cpu", "cuda"))
        off = [
            ((one - other.cpu()).abs().max() / one.abs().max().clamp_min(1e-30)).item()
            for one, other in zip(here, there, strict=True)
        ]
        rows.append({"op": name, "largest difference": max(off)})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--capture", type=Path, default=ATELIER)
    options = parser.parse_args()
    if not torch.cuda.is_available():
        print("no CUDA device: unmeasured")
        return
    differences = agreement()
    show(differences)
    capture = captured(options.capture)
    rows = []
    for contender in (PLAIN, *OURS):
        rows.append(fitting(contender, capture, options.runs))
        gc.collect()
        torch.cuda.empty_cache()
    show(rows)
    print(save("gpu", rows, {"ops": differences, "runs": options.runs}))


if __name__ == "__main__":
    main()
