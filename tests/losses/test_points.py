"""Indecision: highest in the middle, without a pull at the ends."""

import torch

from sharpfield.losses.regularizers import indecision


def test_one_half_is_worst_and_sides_are_alike():
    confidence = torch.linspace(0.01, 0.99, 99)
    each = torch.stack([indecision(one[None]) for one in confidence])
    assert each.argmax() == 49
    assert torch.allclose(each, each.flip(0), atol=1e-4)


def test_it_does_not_push_beyond_the_ends():
    ends = torch.tensor([0.0, 1.0, 0.3], requires_grad=True)
    indecision(ends).backward()
    assert ends.grad is not None
    assert ends.grad[:2].tolist() == [0, 0]
    assert ends.grad[2] > 0  # descent leads to 0


def test_no_points_are_fine():
    assert indecision(torch.zeros(0)) == 0
