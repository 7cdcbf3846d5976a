import copy

import torch

from sharpfield.formation.response import _slope, _views, fit_identity
from sharpfield.ops.dense import Dense


def network() -> Dense:
    made = torch.Generator().manual_seed(0)
    return Dense([3, 16, 16, 16, 1], generator=made).double()


def error(net: Dense, x: torch.Tensor) -> torch.Tensor:
    read = torch.cat([x, x.new_zeros(len(x), 2)], -1)
    return (torch.sigmoid(x + 0.1 * net(read)) - x).square().mean()


def test_slopes_by_hand_are_those_of_autograd():
    net, x = network(), torch.rand(50, 1, dtype=torch.float64)
    error(net, x).backward()
    first, *rest = net.parameters()
    parts = [first[:, :1], *rest]
    flat = torch.cat([part.detach().flatten() for part in parts]).numpy()
    layers = _views(flat, [tuple(part.shape) for part in parts])
    grads = [first.grad[:, :1], *(p.grad for p in rest)]
    expected = torch.cat([grad.flatten() for grad in grads])
    torch.testing.assert_close(torch.from_numpy(_slope(layers, x.numpy(), 0.1)), expected)


def test_the_steps_are_those_of_adam():
    ours, theirs = network(), network()
    fit_identity(ours, step=0.1, generator=torch.Generator().manual_seed(42), steps=30)
    optimizer = torch.optim.Adam(theirs.parameters(), lr=1e-2)
    draws = torch.Generator().manual_seed(42)
    for x in torch.rand(30, 192, 1, generator=draws, dtype=torch.float64):
        optimizer.zero_grad()
        error(theirs, x).backward()
        optimizer.step()
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_it_nears_the_identity_and_leaves_other_inputs_as_they_were():
    net = network()
    before = copy.deepcopy(net)
    fit_identity(net, step=0.1, generator=torch.Generator().manual_seed(42), steps=500)
    x = torch.linspace(0, 1, 50, dtype=torch.float64)[:, None]
    assert error(net, x) < 0.1 * error(before, x)
    old, new = next(before.parameters()), next(net.parameters())
    assert torch.equal(old[:, 1:], new[:, 1:]) and not torch.equal(old[:, :1], new[:, :1])
