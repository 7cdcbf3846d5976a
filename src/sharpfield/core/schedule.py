"""Numbers that depend on the training step, as plain functions of it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import nn

Schedule = Callable[[int], float]


def constant(value: float) -> Schedule:
    """The same number at every step."""
    return lambda step: value


def scaled(schedule: Schedule, factor: float) -> Schedule:
    """Another schedule times a number."""
    return lambda step: factor * schedule(step)


def linear(start: float, end: float, *, begin: int, until: int) -> Schedule:
    """`start` up to step `begin`, `end` from step `until`, straight in between."""
    return lambda step: start + (end - start) * _progress(step, begin, until)


def cosine(start: float, end: float, *, begin: int, until: int) -> Schedule:
    """`start` up to step `begin`, `end` from step `until`, half a cosine in between."""
    return lambda step: (
        end + (start - end) * 0.5 * (1 + math.cos(math.pi * _progress(step, begin, until)))
    )


def exponential(start: float, end: float, *, until: int, begin: int = 0) -> Schedule:
    """Changes by a constant factor per step, from `start` to `end`, and on beyond `until`.

    It is not clamped at `until`: published learning rates are given as "a tenth every so many
    steps" and keep falling.
    """
    _ordered(begin, until)
    return lambda step: start * (end / start) ** (max(step - begin, 0) / (until - begin))


def staircase(values: Sequence[float], *, edges: Sequence[int]) -> Schedule:
    """`values[i]` from step `edges[i]` on; `values[0]` also before the first edge."""
    if len(values) != len(edges) or list(edges) != sorted(edges):
        raise ValueError(f"staircase: {len(values)} values need as many ascending edges: {edges}")

    def at(step: int) -> float:
        passed = [value for value, edge in zip(values, edges, strict=True) if step >= edge]
        return passed[-1] if passed else values[0]

    return at


def _progress(step: int, begin: int, until: int) -> float:
    _ordered(begin, until)
    return min(max((step - begin) / (until - begin), 0.0), 1.0)


def _ordered(begin: int, until: int) -> None:
    if not begin < until:
        raise ValueError(f"schedule: begin={begin} must be before until={until}")


@dataclass(frozen=True)
class Group:
    """Parameters that share a learning rate."""

    name: str
    parameters: tuple[nn.Parameter, ...]
    rate: Schedule
