from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from sharpfield.core.measurements import Pixels
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.struct import Struct


def rays(*shape: int) -> Rays:
    """Rays whose every number is another."""
    count = torch.Size(shape).numel()
    numbers = torch.arange(8.0 * count).reshape(8, *shape)
    return Rays(numbers[:3].movedim(0, -1), numbers[3:6].movedim(0, -1), numbers[6], numbers[7])


def radiance(*shape: int) -> Radiance:
    """With a coarse part, without samples."""
    made = rays(*shape)
    inner = Radiance(made.origin, made.time, made.time, made.weight)
    return Radiance(made.direction, made.weight, made.weight, made.time, coarse=inner)


def leaves(struct: Struct) -> list[Tensor]:
    """Every tensor, also of nested structs."""
    found: list[Tensor] = []
    struct.map(lambda tensor, _: found.append(tensor) or tensor)
    return found


def same(first: Struct, second: Struct) -> bool:
    pairs = zip(leaves(first), leaves(second), strict=True)
    return type(first) is type(second) and all(torch.equal(a, b) for a, b in pairs)


def test_leading_axes():
    assert rays(4, 2).shape == (4, 2)
    assert len(rays(4, 2)) == 4
    assert radiance(5).shape == (5,)


INDICES = [
    0,
    -1,
    slice(1, 3),
    slice(None, None, 2),
    (slice(None), 0),
    (2, 1),
    (Ellipsis, 0),
    (Ellipsis, slice(1)),
    (slice(None), None),
    torch.tensor([3, 0, 0]),
    torch.tensor([True, False, True, True]),
    (torch.tensor([0, 1]), torch.tensor([1, 0])),
    (Ellipsis, torch.tensor([1, 0])),
]


@pytest.mark.parametrize("index", INDICES, ids=str)
def test_an_index_speaks_of_leading_axes_only(index: object):
    """Against the indices themselves: numbers in an array of the leading axes."""
    made = rays(4, 2)
    chosen = torch.arange(8).reshape(4, 2)[index]
    part = made[index]
    assert part.shape == chosen.shape
    assert torch.equal(part.time, made.time.reshape(8)[chosen])
    assert torch.equal(part.direction, made.direction.reshape(8, 3)[chosen])


def test_reshaping_there_and_back():
    made = radiance(4, 3)
    flat = made.reshape(-1)
    assert flat.shape == (12,) and flat.rgb.shape == (12, 3)
    assert flat.coarse is not None and flat.coarse.rgb.shape == (12, 3)
    assert same(flat.reshape(4, 3), made)


def test_a_single_ray():
    made = rays(1)
    assert made.reshape().shape == () and same(made.reshape().reshape(1), made)


def test_joining_undoes_splitting():
    made = radiance(7)
    assert same(Radiance.cat([made[:2], made[2:2], made[2:]]), made)
    assert made.samples is None


def test_a_map_leaves_the_original_alone():
    made = rays(3)
    before = made.time.clone()
    doubled = made.map(lambda tensor, _: 2 * tensor)
    assert torch.equal(made.time, before)
    assert torch.equal(doubled.time, 2 * before)


def test_moving_moves_everything():
    moved = radiance(3).to("meta")
    assert moved.device.type == "meta"
    assert all(tensor.is_meta for tensor in leaves(moved))


def test_gradients_pass_through():
    weight = torch.ones(4, 2, requires_grad=True)
    made = rays(4, 2)
    part = Rays(made.origin, made.direction, made.time, weight).reshape(-1)[2:5]
    part.weight.sum().backward()
    assert weight.grad is not None
    assert weight.grad.tolist() == [[0, 0], [1, 1], [1, 0], [0, 0]]


def test_other_fields_ride_along():
    @dataclass(frozen=True)
    class Named(Struct):
        trailing: ClassVar = {}
        value: Tensor
        name: str

    made = Named(torch.arange(4), "left")
    assert made[1:].name == "left"
    assert Named.cat([made, made]).value.tolist() == [0, 1, 2, 3, 0, 1, 2, 3]


def test_none():
    empty = rays(0)
    assert len(empty) == 0 and empty.reshape(-1).shape == (0,)
    assert len(Rays.cat([empty, rays(2)])) == 2


def test_a_struct_without_tensors_has_no_shape():
    with pytest.raises(AssertionError, match="Struct holds no tensor"):
        _ = dataclass(frozen=True)(type("EmptyStruct", (Struct,), {}))().shape


def test_the_middle_of_an_exposure_is_computed_for_any_shape():
    half = torch.full((2, 3), 0.5)
    number = torch.zeros(2, 3, dtype=torch.int64)
    seen = Pixels(torch.zeros(2, 3, 2), number, number, half, half + 0.2, torch.zeros(2, 3, 1))
    torch.testing.assert_close(seen[1].middle, torch.full((3,), 0.6))
