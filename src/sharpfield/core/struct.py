"""Frozen structs of tensors that share their leading axes.

A struct is a frozen dataclass whose tensor fields agree on their leading axes and may have
trailing axes of their own (a direction has 3). `trailing` says how many, so that a struct can be
moved, indexed, reshaped and concatenated as one thing. This is the only inheritance in the
project besides `nn.Module`, `Protocol` and `Exception`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

S = TypeVar("S", bound="Struct")
"""Not `Self`: beartype checks methods one by one and cannot resolve it there."""


class Struct:
    """Tensors with common leading axes; subclasses are frozen dataclasses."""

    trailing: ClassVar[dict[str, int]] = {}
    """Trailing axes of each field that has any; fields not named here have none."""

    def __init_subclass__(cls) -> None:
        """Keep the short text below where `dataclass` would write one with all numbers in it."""
        super().__init_subclass__()
        cls.__repr__ = Struct.__repr__

    def __repr__(self) -> str:
        """As a dataclass, its tensors by their shapes alone."""
        shown: list[str] = []
        for name, value in self._fields():
            shape: Any = getattr(value, "shape", None)
            if value is not None:
                text = repr(value) if shape is None or isinstance(value, Struct) else str([*shape])
                shown.append(f"{name}={text}")
        return f"{type(self).__name__}({', '.join(shown)})"

    def map(self: S, change: Callable[[Tensor, int], Tensor]) -> S:
        """Apply `change(tensor, trailing axes)` to every tensor, also inside nested structs."""
        changed: dict[str, Any] = {}
        for name, value in self._fields():
            if isinstance(value, Tensor):
                changed[name] = change(value, self.trailing.get(name, 0))
            elif isinstance(value, Struct):
                changed[name] = value.map(change)
        return dataclasses.replace(self, **changed)  # pyright: ignore

    def to(self: S, device: torch.device | str) -> S:
        """The same struct on another device."""
        return self.map(lambda tensor, _: tensor.to(device))

    def __getitem__(self: S, index: Any) -> S:
        """Index the leading axes; every field keeps its trailing axes whole."""
        parts: list[Any] = [*index] if isinstance(index, tuple) else [index]
        reaches_last = any(part is Ellipsis for part in parts)

        def pick(tensor: Tensor, trailing: int) -> Tensor:
            whole = [slice(None)] * trailing if reaches_last else []
            return tensor[(*parts, *whole)]

        return self.map(pick)

    def reshape(self: S, *shape: int) -> S:
        """Give the leading axes another shape."""
        return self.map(
            lambda tensor, trailing: tensor.reshape(
                (*shape, *tensor.shape[tensor.ndim - trailing :])
            )
        )

    def _first(self) -> tuple[str, Tensor]:
        """The first tensor, and the name of its field."""
        for name, value in self._fields():
            if isinstance(value, Tensor):
                return name, value
        raise AssertionError(f"{type(self).__name__} holds no tensor")

    @property
    def shape(self) -> torch.Size:
        """The leading axes."""
        name, tensor = self._first()
        return tensor.shape[: tensor.ndim - self.trailing.get(name, 0)]

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self._first()[1].device

    def __len__(self) -> int:
        """Size of the first leading axis."""
        return self.shape[0]

    @classmethod
    def cat(cls: type[S], items: Sequence[S], axis: int = 0) -> S:
        """Join structs along a leading axis. A field is None in all of them or in none."""
        joined: dict[str, Any] = {}
        for field in dataclasses.fields(cls):  # pyright: ignore[reportArgumentType]
            values = [getattr(item, field.name) for item in items]
            if isinstance(values[0], Tensor):
                joined[field.name] = torch.cat(values, axis)
            elif isinstance(values[0], Struct):
                joined[field.name] = type(values[0]).cat(values, axis)
        return dataclasses.replace(items[0], **joined)  # pyright: ignore

    def _fields(self) -> list[tuple[str, Any]]:
        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        return [(field.name, getattr(self, field.name)) for field in fields]


def device_of(part: object) -> torch.device:
    """The device of a module's tensors; the CPU if it is no module, or has none."""
    if not isinstance(part, nn.Module):
        return torch.device("cpu")
    held = next(chain(part.parameters(), part.buffers()), None)
    return torch.device("cpu") if held is None else held.device
