import itertools

import numpy as np
import pytest
import torch

from sharpfield.core import seed


def test_the_same_three_give_the_same_numbers():
    first, second = (torch.rand(8, generator=seed.generator(3, 700, "pixels")) for _ in range(2))
    assert torch.equal(first, second)
    first, second = (seed.numpy_generator(3, 700, "pixels").random(8) for _ in range(2))
    assert np.array_equal(first, second)


def test_each_of_the_three_matters():
    names = itertools.product((0, 1, 11), (0, 1, 11), ("pixels", "pairs"))
    numbers = [seed.number(*name) for name in names]
    assert len(set(numbers)) == 18


def test_streams_are_independent():
    drawn = np.stack(
        [
            torch.rand(4000, generator=seed.generator(0, step, stream)).numpy()
            for step in (0, 1)
            for stream in ("pixels", "pairs", "noise")
        ]
    )
    correlation = np.corrcoef(drawn) - np.eye(6)
    assert np.abs(correlation).max() < 0.06  # four standard deviations
    np.testing.assert_allclose(drawn.mean(1), 0.5, atol=0.02)


def test_the_global_generator_is_left_alone():
    torch.manual_seed(1)
    state = torch.get_rng_state()
    torch.rand(3, generator=seed.generator(0, 0, "x"))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [((0, 0, "pixels"), 8609589554289205056), ((10_000, 29_999, "pairs"), 3881994747880199508)],
)
def test_numbers_never_change(name: tuple[int, int, str], wanted: int):
    """Else a run could not be repeated with a later version."""
    assert seed.number(*name) == wanted
    assert 0 <= wanted < 2**63
