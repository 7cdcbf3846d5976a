import numpy as np
import pytest

from sharpfield.core.seed import evenly_spread


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
@pytest.mark.parametrize("most", [1, 2, 5, 7, 64])
def test_rows_keep_their_order_and_their_distances(count: int, most: int):
    found = evenly_spread(np.arange(count), most)
    assert len(found) == min(count, most)
    if len(found) > 1:
        steps = np.diff(found)
        assert (found[0], found[-1]) == (0, count - 1)
        assert steps.min() > 0 and steps.max() - steps.min() <= 1


@pytest.mark.parametrize(
    ("most", "wanted"), [(0, []), (1, [10]), (2, [10, 14]), (3, [10, 12, 14]), (9, None)]
)
def test_a_few_of_five(most: int, wanted: list[int] | None):
    five = np.arange(10, 15)
    assert evenly_spread(five, most).tolist() == (five.tolist() if wanted is None else wanted)


def test_rows_may_have_columns():
    assert evenly_spread(np.arange(10).reshape(5, 2), 2).tolist() == [[0, 1], [8, 9]]
