"""A shuffle without a table is a shuffle."""

import numpy as np
import pytest

from sharpfield.core.seed import shuffled


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 15, 16, 17, 255, 1000, 4096, 4097, 100_003])
def test_every_number_comes_once(n: int) -> None:
    found = shuffled(np.arange(n), n, seed=1, epoch=0)
    np.testing.assert_array_equal(np.sort(found), np.arange(n))


def test_reproducible_and_different_for_every_seed_and_epoch() -> None:
    positions = np.arange(1000)
    first = shuffled(positions, 1000, seed=0, epoch=0)
    np.testing.assert_array_equal(first, shuffled(positions, 1000, seed=0, epoch=0))
    for seed, epoch in ((0, 1), (1, 0)):
        agree = shuffled(positions, 1000, seed=seed, epoch=epoch) == first
        assert agree.mean() < 0.01


def test_a_part_equals_the_part_of_the_whole() -> None:
    whole = shuffled(np.arange(999), 999, seed=3, epoch=2)
    part = np.array([[5, 998], [0, 5]])
    np.testing.assert_array_equal(shuffled(part, 999, seed=3, epoch=2), whole[part])


def test_a_short_stretch_is_spread_evenly() -> None:
    n, bins = 1_000_000, 50
    drawn = shuffled(np.arange(50_000), n, seed=0, epoch=0)
    counted = np.bincount(drawn * bins // n, minlength=bins)
    chi_square = ((counted - 1000) ** 2 / 1000).sum()
    assert chi_square < 85  # 49 degrees of freedom: less than one chance in a thousand


def test_neighbours_are_unrelated() -> None:
    drawn = shuffled(np.arange(100_000), 100_000, seed=0, epoch=0)
    assert abs(np.corrcoef(drawn[1:], drawn[:-1])[0, 1]) < 0.02
    assert (np.abs(np.diff(drawn)) == 1).sum() < 15


def test_every_place_is_equally_likely_for_a_number() -> None:
    found = [int(shuffled(np.array([0]), 7, seed=seed, epoch=0)[0]) for seed in range(2100)]
    counted = np.bincount(found, minlength=7)
    assert ((counted - 300) ** 2 / 300).sum() < 22.5  # 6 degrees of freedom, one in a thousand


def test_larger_than_any_table() -> None:
    n = 2**61 + 12345
    found = shuffled(np.array([0, 1, n - 1]), n, seed=0, epoch=0)
    assert len(set(found.tolist())) == 3 and found.min() >= 0 and found.max() < n


def test_nothing_drawn() -> None:
    assert shuffled(np.zeros(0, np.int64), 10, seed=0, epoch=0).shape == (0,)


def test_position_outside_is_refused() -> None:
    with pytest.raises(ValueError, match="positions must be 0 to 9"):
        shuffled(np.array([10]), 10, seed=0, epoch=0)
