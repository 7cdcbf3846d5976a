"""Adam on rows: each row moves as if it had an Adam of its own, asked only when it takes part."""

from collections.abc import Mapping

import torch
from torch import nn

from sharpfield.core.protocols import Growth
from sharpfield.ops.dense import take_rows
from sharpfield.training.optim import ROW_STEPS, RowAdam, apply_growth


def slopes(step: int) -> torch.Tensor:
    return torch.randn(6, 3, generator=torch.Generator().manual_seed(step))


def taken(step: int) -> torch.Tensor:
    return torch.tensor([[0, 2, 5], [2, 3], [0, 1, 2, 3, 4, 5], [5]][step % 4])


def test_rows_move_as_with_an_adam_of_their_own():
    table = nn.Parameter(torch.ones(6, 3))
    optimizer = RowAdam([table], lr=0.1)
    single = [nn.Parameter(torch.ones(3)) for _ in range(6)]
    singles = [torch.optim.Adam([row], lr=0.1) for row in single]
    for step in range(12):
        rows = taken(step)
        optimizer.zero_grad(set_to_none=True)
        (take_rows(table, rows) * slopes(step)[rows]).sum().backward()
        optimizer.step()
        for row in rows.tolist():
            single[row].grad = slopes(step)[row]
            singles[row].step()
    expected = torch.stack([row.detach() for row in single])
    assert torch.allclose(table.detach(), expected, atol=1e-6)


def test_dense_gradients_get_plain_adam():
    one, other = (nn.Parameter(torch.ones(6, 3)) for _ in range(2))
    ours, plain = RowAdam([one], lr=0.1), torch.optim.Adam([other], lr=0.1)
    for step in range(5):
        one.grad, other.grad = slopes(step), slopes(step)
        ours.step()
        plain.step()
    assert torch.equal(one, other)


def test_gradients_are_still_there_afterwards():
    table = nn.Parameter(torch.ones(6, 3))
    take_rows(table, taken(0)).sum().backward()
    RowAdam([table], lr=0.1).step()
    assert table.grad is not None
    assert table.grad.is_sparse


class Table(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.ones(6, 3))

    def points(self) -> dict[str, torch.Tensor]:
        return {"values": self.values}

    def replace(self, points: Mapping[str, torch.Tensor]) -> None:
        self.values = nn.Parameter(points["values"].detach())


def test_counts_follow_their_rows_when_points_grow():
    table = Table()
    optimizer = RowAdam([table.values], lr=0.1)
    for step in range(2):
        optimizer.zero_grad(set_to_none=True)
        take_rows(table.values, taken(step)).sum().backward()
        optimizer.step()
    source = torch.tensor([2, 3, 2])
    apply_growth(table, optimizer, Growth(source, torch.tensor([False, False, True])))
    assert optimizer.state[table.values][ROW_STEPS].tolist() == [2, 1, 0]
    optimizer.zero_grad(set_to_none=True)
    take_rows(table.values, torch.tensor([0, 2])).sum().backward()
    optimizer.step()
    assert optimizer.state[table.values][ROW_STEPS].tolist() == [3, 1, 1]
