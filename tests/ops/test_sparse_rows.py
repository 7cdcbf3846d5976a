"""Taking rows: the right values, and a gradient that holds no other rows."""

import torch

from sharpfield.ops.dense import compact, take_rows


def test_values_and_gradient_are_those_of_indexing():
    table = torch.randn(9, 4, requires_grad=True)
    rows = torch.tensor([1, 4, 8])
    weight = torch.randn(3, 4)
    (take_rows(table, rows) * weight).sum().backward()
    assert torch.equal(take_rows(table, rows), table[rows])
    assert table.grad is not None and table.grad.is_sparse
    assert torch.equal(table.grad.to_dense()[rows], weight)
    assert torch.equal(table.grad._indices()[0], rows)


def test_two_takes_add_up():
    table = torch.zeros(5, 2, requires_grad=True)
    loss = take_rows(table, torch.tensor([0, 2])).sum() + take_rows(table, torch.tensor([2])).sum()
    loss.backward()
    assert table.grad is not None
    assert table.grad.to_dense()[:, 0].tolist() == [1, 0, 2, 0, 0]


def test_compact_lists_each_row_once():
    rows = torch.tensor([[7, 3], [3, 9]])
    taken, place = compact(rows)
    assert taken.tolist() == [3, 7, 9]
    assert torch.equal(taken[place], rows)
