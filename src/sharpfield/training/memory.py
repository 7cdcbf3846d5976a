"""How much memory a training step needs, and gradient accumulation over micro-batches that fit.

Most of the memory in training holds tensors saved for the backward pass. Their bytes are measured
on small fractions of the batch of the heaviest step of the schedule and extrapolated to the full
batch, which is then split into as many micro-batches as the budget requires. Losses are means over
the batch, so the gradient of the batch is the mean of the gradients of equal micro-batches.
"""

import math
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import Batch
from sharpfield.core.protocols import Model
from sharpfield.training.optim import module_of

MEMORY_FRACTION = 0.7
"""Fraction of the available memory that training may use."""
PEAK_FACTOR = 1.6
"""Peak memory over saved bytes; temporaries come on top (1.5 with Ev-DeblurNeRF)."""
PROBE_FRACTIONS = (16, 8)
"""Saved bytes are measured on 1/16 and 1/8 of a batch."""
COPIES = 3
"""Tensors per parameter besides itself: its gradient and Adam's two moments."""
GIB = 1024**3

Losses = dict[str, Float[Tensor, ""]]
"""Loss terms of a step by name; their sum is minimised."""


def accumulate(model: Model, batch: Batch, step: int, *, micro_batches: int) -> Losses:
    """Add the gradients of the batch's losses to the parameters, micro-batch by micro-batch.

    Returns:
        The detached loss terms of the whole batch.
    """
    whole: Losses = {}
    for micro_batch, share in split_batch(batch, micro_batches):
        terms = model.losses(micro_batch, step)
        losses = {name: share * loss for name, loss in terms.items()}
        torch.stack(list(losses.values())).sum().backward()
        for name, loss in losses.items():
            whole[name] = whole[name] + loss.detach() if name in whole else loss.detach()
    return whole


def split_batch(batch: Batch, micro_batches: int) -> Iterator[tuple[Batch, float]]:
    """Split every entry of a batch into consecutive slices.

    Yields:
        A micro-batch, and its share of the batch. The shares add up to one.
    """
    for i in range(micro_batches):
        part = {name: seen[_slice(len(seen), i, micro_batches)] for name, seen in batch.items()}
        shares = [len(part[name]) / len(seen) for name, seen in batch.items() if len(seen)]
        yield part, sum(shares) / len(shares) if shares else 1 / micro_batches


def plan_micro_batches(model: Model, *, budget_bytes: int) -> int:
    """Number of micro-batches with which a step stays within a memory budget.

    Raises:
        OptionError: The step does not fit, however finely its batch is split.
    """
    step = model.heaviest_step
    batch = model.draw(step)
    fixed, growing = _memory_line(model, batch, step)
    parameters = sum(
        parameter.numel() * parameter.element_size()
        for parameter in module_of(model).parameters()
        if parameter.requires_grad
    )
    free = budget_bytes - COPIES * parameters - PEAK_FACTOR * fixed
    lengths = [len(seen) for seen in batch.values() if len(seen)]
    most = min(lengths)  # an empty micro-batch has no mean
    smallest = math.ceil(PEAK_FACTOR * growing / free) if free > 0 else most + 1
    if smallest > most:
        needed = COPIES * parameters + PEAK_FACTOR * (fixed + growing / most)
        raise OptionError(
            "one training step does not fit in the memory budget, however it is split",
            got=f"a budget of {budget_bytes / GIB:.2f} GiB, at least {needed / GIB:.2f} GiB needed",
            do="raise `memory_gb` (--memory-gb), or choose a smaller preset",
        )
    return _even(max(smallest, 1), lengths)


def saved_bytes(model: Model, batch: Batch, step: int) -> int:
    """Bytes that the forward pass of a batch saves for the backward pass, without parameters."""
    own = {parameter.untyped_storage().data_ptr() for parameter in module_of(model).parameters()}
    saved: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in own:
            saved[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        losses = model.losses(batch, step)  # kept alive while counting: no address is used twice
    total = sum(saved.values())
    del losses
    return total


def available_bytes(device: torch.device) -> int:
    """Memory in bytes that is free on a device now."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2]
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        limits = [int(fields["MemAvailable"].split()[0]) * 1024]
    group = Path("/sys/fs/cgroup")  # a container may have less than the machine
    if (group / "memory.max").exists() and (limit := (group / "memory.max").read_text()) != "max\n":
        limits.append(int(limit) - int((group / "memory.current").read_text()))
    return max(min(limits), 0)


def peak_memory_mb(device: torch.device) -> float:
    """Peak memory so far in MiB: of the device if it has its own, else of the process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _memory_line(model: Model, batch: Batch, step: int) -> tuple[float, float]:
    """Saved bytes as a line in the fraction of the batch: its offset and slope."""
    small, large = (
        saved_bytes(model, {name: seen[: -(-len(seen) // s)] for name, seen in batch.items()}, step)
        for s in PROBE_FRACTIONS
    )
    growing = max(large - small, 0) / (1 / PROBE_FRACTIONS[1] - 1 / PROBE_FRACTIONS[0])
    return max(small - growing / PROBE_FRACTIONS[0], 0.0), growing


def _slice(length: int, part: int, micro_batches: int) -> slice:
    return slice(length * part // micro_batches, length * (part + 1) // micro_batches)


def _even(smallest: int, lengths: list[int]) -> int:
    """A number that divides every length, if there is one between the smallest and its double."""
    common = math.gcd(*lengths)
    exact = (
        micro_batches
        for micro_batches in range(smallest, 2 * smallest + 1)
        if common % micro_batches == 0
    )
    return next(exact, smallest)
