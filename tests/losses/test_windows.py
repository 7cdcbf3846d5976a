"""Errors of windows: golden values, dead zones, and what is left over."""

import pytest
import torch

from sharpfield.losses.events import counted_error, dead_zone_error, exact_error, scaled_error

C = 0.2


def number(value: float) -> torch.Tensor:
    return torch.tensor([value])


def test_scaled_error_is_least_at_the_compressed_change():
    change = number(2.2 * 4.0 / 22.6).requires_grad_()
    loss = scaled_error(change, number(4.0), scale=2.2, measured_scale=22.6)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=1e-12)
    assert change.grad.item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "measured", "expected"),
    [
        (0.0, 0.0, 0.0),
        (0.15, 0.0, 0.0),
        (0.2, 0.0, 0.04),  # one threshold: an event
        (-0.05, 0.0, 0.0025),  # published: darker costs at once
        (0.4, 0.4, 0.0),
        (0.59, 0.4, 0.0),
        (0.39, 0.4, (0.39 - 0.5) ** 2),
        (0.61, 0.4, (0.61 - 0.5) ** 2),
        (-0.4, -0.4, 0.0),
        (-0.59, -0.4, 0.0),
        (-0.61, -0.4, (0.61 - 0.5) ** 2),
    ],
)
def test_dead_zone(change: float, measured: float, expected: float):
    found = dead_zone_error(number(change), number(measured), C)
    assert found.item() == pytest.approx(expected, abs=1e-6)


def test_exact_errors_are_in_thresholds_and_robust():
    threshold = number(C)
    found = [exact_error(number(x), number(0.4), threshold).item() for x in (0.4, 0.5, 0.6, 1.0)]
    assert found == pytest.approx([0, 0.25, 1, 5], abs=1e-5)


def test_what_is_left_over_costs_nothing():
    threshold = number(C)
    found = [counted_error(number(x), number(0.4), threshold).item() for x in (0.25, 0.55, 0.7)]
    assert found == pytest.approx([0, 0, 0.25], abs=1e-5)
    pulled = counted_error(number(0.5), number(0.4), threshold, pull=0.2).item()
    assert pulled == pytest.approx(0.2 * 0.25, abs=1e-5)


def test_both_signs_are_treated_alike():
    threshold = number(C)
    for change in (0.1, 0.5, 0.9):
        one = counted_error(number(change), number(0.4), threshold, pull=0.1)
        other = counted_error(number(-change), number(-0.4), threshold, pull=0.1)
        assert one == other
