"""Every fast version of every op computes what its reference does: values and gradients."""

import importlib.util
import pkgutil
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from sharpfield import ops
from sharpfield.ops._dispatch import Op, registered, using

for _module in pkgutil.iter_modules(ops.__path__, "sharpfield.ops."):
    importlib.import_module(_module.name)

OPS = list(registered().values())
TOLERANCE = {"cpu": 2e-5, "cuda": 1e-3}
"""Of the largest value, in float32. GPUs take short cuts in exponentials."""

FAST = [(op, device) for op in OPS for device in op.fast()]


def tensors(value: Any) -> Iterator[Tensor]:
    """All floating-point tensors in nested sequences."""
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from tensors(part)


def replaced(value: Any, new: Iterator[Tensor]) -> Any:
    """The same arguments with their floating-point tensors taken from `new`, in order."""
    if isinstance(value, Tensor):
        return next(new) if value.is_floating_point() else value
    if isinstance(value, list | tuple):
        return type(value)(replaced(part, new) for part in value)
    return value


def leaves_of(arguments: Any, device: str, dtype: torch.dtype) -> list[Tensor]:
    """The floating-point tensors of the arguments, elsewhere, ready for gradients."""
    return [t.detach().to(device, dtype).requires_grad_() for t in tensors(arguments)]


def example(op: Op[..., Any]) -> tuple[Any, ...]:
    assert op.example is not None, f"{op.name} says no example: add @{op.__name__}.exemplify"
    return op.example(torch.Generator().manual_seed(1), 1)


def value_and_gradients(op: Op[..., Any], choice: str, leaves: list[Tensor]) -> list[Tensor]:
    with using(choice):
        values = list(tensors(op(*replaced(example(op), iter(leaves)))))
    generator = torch.Generator().manual_seed(2)
    weights = [torch.randn(v.shape, generator=generator).to(v) for v in values]
    loss = torch.stack([(v * w).sum() for v, w in zip(values, weights, strict=True)]).sum()
    return [*values, *torch.autograd.grad(loss, leaves)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize(("op", "device"), FAST, ids=[f"{op.name}-{on}" for op, on in FAST])
def test_fast_equals_reference(op: Op[..., Any], device: str, dtype: torch.dtype) -> None:
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if importlib.util.find_spec(needs := op.fast()[device][0]) is None:
        pytest.skip(f"{needs} is not installed")
    leaves = leaves_of(example(op), device, dtype)
    expected = value_and_gradients(op, "reference", leaves)
    found = value_and_gradients(op, "fast", leaves)
    tolerance = 1e-11 if dtype == torch.float64 else TOLERANCE[device]
    for one, other in zip(expected, found, strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        error = (one - other).abs().max() / one.abs().max().clamp_min(1e-30)
        assert error <= tolerance, f"off by {error:.1e} of the largest value"


@pytest.mark.parametrize("op", [op for op, on in FAST if on == "cpu"], ids=lambda op: op.name)
def test_fast_gives_the_same_bits_on_any_number_of_threads(op: Op[..., Any]) -> None:
    leaves = leaves_of(example(op), "cpu", torch.float32)
    before = torch.get_num_threads()
    try:
        runs = []
        for threads in (1, 2, 3, 2):
            torch.set_num_threads(threads)
            runs.append(value_and_gradients(op, "fast", leaves))
    finally:
        torch.set_num_threads(before)
    for run in runs[1:]:
        assert all(torch.equal(one, other) for one, other in zip(runs[0], run, strict=True))


@pytest.mark.parametrize("op", OPS, ids=lambda op: op.name)
def test_reference_has_the_right_gradient(op: Op[..., Any]) -> None:
    arguments = example(op)

    def call(*leaves: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensors(op.reference(*replaced(arguments, iter(leaves)))))

    leaves = leaves_of(arguments, "cpu", torch.float64)
    assert torch.autograd.gradcheck(call, leaves, fast_mode=True)
