"""How much memory a step needs, and working a batch off in parts that fit.

What fills the memory in training are the tensors kept for the backward pass. They are counted on
small slices of the batch of the most expensive step of the whole schedule, extrapolated to the
full batch, and the batch is split into as many *parts* as the budget asks for. The losses are
means over the batch, so the gradient of the whole is the mean of the gradients of equal parts.
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

SHARE = 0.7
"""Part of the available memory that training may take."""
TRANSIENT = 1.6
"""Peak over kept bytes: what is held only for a moment comes on top (1.5 with Ev-DeblurNeRF)."""
SLICES = (16, 8)
"""The kept bytes are measured on this fraction of a batch."""
COPIES = 3
"""Per parameter, besides itself: its gradient and Adam's two moments."""
GIB = 1024**3

Losses = dict[str, Float[Tensor, ""]]
"""The terms of a step by name; what is minimised is their sum."""


def accumulate(model: Model, batch: Batch, step: int, *, parts: int) -> Losses:
    """Add the gradients of the batch's losses to the parameters, part by part.

    Returns:
        The detached loss terms of the whole batch.
    """
    whole: Losses = {}
    for part, share in split(batch, parts):
        losses = {name: share * loss for name, loss in model.losses(part, step).items()}
        torch.stack(list(losses.values())).sum().backward()
        for name, loss in losses.items():
            whole[name] = whole[name] + loss.detach() if name in whole else loss.detach()
    return whole


def split(batch: Batch, parts: int) -> Iterator[tuple[Batch, float]]:
    """Cut every entry of a batch into `parts` consecutive slices.

    Yields:
        A part, and its share of the batch. The shares add up to one.
    """
    for i in range(parts):
        part = {name: seen[_slice(len(seen), i, parts)] for name, seen in batch.items()}
        shares = [len(part[name]) / len(seen) for name, seen in batch.items() if len(seen)]
        yield part, sum(shares) / len(shares) if shares else 1 / parts


def plan_parts(model: Model, *, budget_bytes: int) -> int:
    """In how many parts each batch has to be worked off to stay within a budget.

    Raises:
        OptionError: It does not fit, however finely it is split.
    """
    step = model.heaviest_step
    batch = model.draw(step)
    fixed, growing = _memory_line(model, batch, step)
    parameters = sum(
        parameter.numel() * parameter.element_size()
        for parameter in module_of(model).parameters()
        if parameter.requires_grad
    )
    free = budget_bytes - COPIES * parameters - TRANSIENT * fixed
    lengths = [len(seen) for seen in batch.values() if len(seen)]
    most = min(lengths)  # no part may be without measurements: their mean would not exist
    smallest = math.ceil(TRANSIENT * growing / free) if free > 0 else most + 1
    if smallest > most:
        needed = COPIES * parameters + TRANSIENT * (fixed + growing / most)
        raise OptionError(
            "one training step does not fit in the memory budget, however it is split",
            got=f"a budget of {budget_bytes / GIB:.2f} GiB, at least {needed / GIB:.2f} GiB needed",
            do="raise --memory-gb, or choose a smaller preset",
        )
    return _even(max(smallest, 1), lengths)


def kept_bytes(model: Model, batch: Batch, step: int) -> int:
    """Bytes that the forward pass of `batch` keeps for the backward pass, parameters left out."""
    own = {parameter.untyped_storage().data_ptr() for parameter in module_of(model).parameters()}
    kept: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in own:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        losses = model.losses(batch, step)  # alive to the end of the count: no address comes twice
    total = sum(kept.values())
    del losses
    return total


def available_bytes(device: torch.device) -> int:
    """Memory that a run could still take on a device, right now."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2]
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        limits = [int(fields["MemAvailable"].split()[0]) * 1024]
    group = Path("/sys/fs/cgroup")  # a container may be granted less than the machine has
    if (group / "memory.max").exists() and (limit := (group / "memory.max").read_text()) != "max\n":
        limits.append(int(limit) - int((group / "memory.current").read_text()))
    return max(min(limits), 0)


def peak_memory_mb(device: torch.device) -> float:
    """Most memory in use so far: of the device if it has its own, else of the process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _memory_line(model: Model, batch: Batch, step: int) -> tuple[float, float]:
    """Kept bytes as a line in the fraction of the batch: what is always there, what grows."""
    small, large = (
        kept_bytes(model, {name: seen[: -(-len(seen) // s)] for name, seen in batch.items()}, step)
        for s in SLICES
    )
    growing = max(large - small, 0) / (1 / SLICES[1] - 1 / SLICES[0])
    return max(small - growing / SLICES[0], 0.0), growing


def _slice(length: int, part: int, parts: int) -> slice:
    return slice(length * part // parts, length * (part + 1) // parts)


def _even(smallest: int, lengths: list[int]) -> int:
    """A number of parts that divides every length, if there is one up to twice the smallest."""
    common = math.gcd(*lengths)
    exact = (parts for parts in range(smallest, 2 * smallest + 1) if common % parts == 0)
    return next(exact, smallest)
