import math

import pytest
import torch
from torch import nn

from sharpfield.core.schedule import Group, constant, cosine, exponential, linear, scaled, staircase


@pytest.mark.parametrize("make", [linear, cosine])
def test_it_starts_and_ends_where_it_says(make):
    at = make(2.0, 5.0, begin=10, until=30)
    assert [at(step) for step in (0, 10, 30, 99)] == pytest.approx([2, 2, 5, 5])
    assert at(20) == pytest.approx(3.5)


@pytest.mark.parametrize("make", [linear, cosine, exponential])
def test_between_it_only_rises(make):
    at = make(2.0, 5.0, begin=10, until=30)
    numbers = [at(step) for step in range(10, 31)]
    assert all(a < b for a, b in zip(numbers, numbers[1:], strict=False))


def test_constant():
    assert {constant(0.3)(step) for step in (0, 7, 10**9)} == {0.3}


def test_scaled_is_the_same_schedule_times_a_number():
    at, tenfold = exponential(1.0, 0.1, until=10), scaled(exponential(1.0, 0.1, until=10), 10.0)
    assert [tenfold(step) for step in (0, 3, 40)] == [10 * at(step) for step in (0, 3, 40)]


def test_linear_golden():
    at = linear(0.0, 1.0, begin=1200, until=2400)
    numbers = [at(step) for step in (0, 1200, 1800, 2399, 2400)]
    assert numbers == pytest.approx([0, 0, 0.5, 1199 / 1200, 1], abs=1e-12)


def test_learning_rate_golden():
    """Ev-DeblurNeRF: a tenth every 10 000 steps, without end."""
    at = exponential(5e-3, 5e-4, until=10_000)
    numbers = [at(step) for step in (0, 1200, 10_000, 20_000, 30_000)]
    assert numbers == pytest.approx([5e-3, 3.792888e-3, 5e-4, 5e-5, 5e-6], rel=1e-6)


def test_prior_weight_golden():
    """Ev-DeblurNeRF: the weight of the sharp images from events."""
    at = cosine(0.01, 1e-5, begin=0, until=10_000)
    steps = (0, 1200, 2500, 5000, 7500, 10_000, 29_999)
    wanted = [0.01, 9.64923e-3, 8.536998e-3, 5.005e-3, 1.473002e-3, 1e-5, 1e-5]
    assert [at(step) for step in steps] == pytest.approx(wanted, rel=1e-6)


def test_exponential_falls_by_a_constant_factor_from_its_beginning_on():
    at = exponential(1.0, 0.25, begin=5, until=7)
    assert [at(step) for step in (0, 5, 6, 7, 9)] == pytest.approx([1, 1, 0.5, 0.25, 0.0625])


def test_cosine_is_half_a_cosine():
    at = cosine(1.0, 0.0, begin=0, until=8)
    wanted = [(1 + math.cos(math.pi * step / 8)) / 2 for step in range(9)]
    assert [at(step) for step in range(9)] == pytest.approx(wanted)


def test_staircase():
    at = staircase([1.0, 2.0, 3.0], edges=[5, 10, 10])
    assert [at(step) for step in (0, 5, 9, 10, 11)] == [1, 1, 1, 3, 3]


def test_a_group_knows_its_rate():
    group = Group("networks", (nn.Parameter(torch.zeros(2)),), constant(1e-3))
    assert group.rate(7) == 1e-3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: linear(0.0, 1.0, begin=5, until=5)(0), "begin=5 must be before until=5"),
        (lambda: exponential(1.0, 2.0, until=0), "begin=0 must be before until=0"),
        (lambda: staircase([1.0], edges=[1, 2]), "1 values need as many ascending edges"),
        (lambda: staircase([1.0, 2.0], edges=[2, 1]), "2 values need as many ascending edges"),
    ],
)
def test_impossible_schedules_are_refused(make, message: str):
    with pytest.raises(ValueError, match=message):
        make()
