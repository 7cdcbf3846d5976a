"""How far views are from counted events: errors in events, and what thresholds learn from them."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sharpfield.core.measurements import EventPairs
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds
from sharpfield.losses.events import count_error, threshold_error

SIZE = (2, 3, 5, 4)
"""Looks, windows, height and width."""
TRUTH = (0.23, 0.31)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def counted(change: Tensor, slack: Tensor | None = None) -> EventPairs:
    """What a sensor without rounding counts of changes `[m, q, h, w, c]`."""
    m, q, h, w, c = change.shape
    y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    time = torch.linspace(0, 1, q + 1)[:, None, None, None]
    return EventPairs(
        xy=torch.stack([x, y], -1)[:, :, None].expand(*change.shape, 2),
        track=torch.zeros(change.shape, dtype=torch.int64),
        start=time[:-1].expand(change.shape),
        end=time[1:].expand(change.shape),
        negative=change.clamp_max(0) / TRUTH[0],
        positive=change.clamp_min(0) / TRUTH[1],
        channel=torch.arange(3).expand(change.shape) if c == 3 else None,
        slack=slack,
    )


def moved(seed: int = 0, size: tuple[int, int, int, int] = SIZE) -> Tensor:
    return torch.randn(*size, 1, generator=generator(seed))


def test_the_right_scene_has_no_error_and_others_have_theirs_in_events():
    change = moved()
    events, exact = counted(change), FixedThresholds(*TRUTH)
    assert float(count_error(change, events, exact)) < 1e-10
    brighter = change + 3 * TRUTH[1] * (change > 0)
    darker = change - 2 * TRUTH[0] * (change < 0)
    share = float((change > 0).float().mean())
    assert float(count_error(brighter, events, exact)) == pytest.approx(9 * share, rel=1e-4)
    assert float(count_error(darker, events, exact)) == pytest.approx(4 * (1 - share), rel=1e-4)


def test_what_may_have_been_rounded_is_no_error():
    """A pixel without events may have changed by up to its slack in thresholds."""
    silent = torch.zeros(*SIZE, 1)
    events = counted(silent, slack=torch.ones_like(silent))
    for change, wanted in ((0.99 * TRUTH[1], 0.0), (-0.99 * TRUTH[0], 0.0), (1.5 * TRUTH[1], 0.25)):
        error = count_error(torch.full_like(silent, change), events, FixedThresholds(*TRUTH))
        assert float(error) == pytest.approx(wanted, abs=1e-6)


def test_the_scene_learns_from_counts_and_thresholds_do_not():
    change = moved().requires_grad_()
    learned = LearnedThresholds(0.4, 0.4)
    error = count_error(change, counted(moved(1)), learned)
    slope = torch.autograd.grad(error, [change, learned.log_factor], allow_unused=True)
    assert slope[0].abs().min() > 0 and slope[1] is None
    small = (2, 1, 2, 2)
    other = counted(moved(1, small).double())
    assert torch.autograd.gradcheck(
        lambda change: count_error(change, other, FixedThresholds(*TRUTH)),
        moved(0, small).double().requires_grad_(),
    )


def pull(change: Tensor, events: EventPairs, thresholds: LearnedThresholds) -> Tensor:
    return torch.autograd.grad(threshold_error(change, events, thresholds), thresholds.log_factor)[
        0
    ]


def learned(*guess: float) -> LearnedThresholds:
    return LearnedThresholds(*(guess or TRUTH))


def test_thresholds_learn_and_the_scene_does_not():
    change = moved().requires_grad_()
    thresholds = learned(0.4, 0.2)
    error = threshold_error(change, counted(moved()), thresholds)
    slope = torch.autograd.grad(error, [change, thresholds.log_factor], allow_unused=True)
    assert slope[0] is None and slope[1].abs().min() > 0


def test_the_error_is_the_mean_square_number_over_the_whole_look():
    change = moved()
    thresholds = learned()
    assert float(threshold_error(change, counted(change), thresholds).detach()) < 1e-10
    off = change + 2 * (TRUTH[0] * TRUTH[1]) ** 0.5 / 3  # in each of three windows
    error = threshold_error(off, counted(change), thresholds)
    assert float(error.detach()) == pytest.approx(4, rel=1e-4)


def test_thresholds_that_are_right_stay():
    change = moved()
    assert pull(change, counted(change), learned()).abs().max() < 1e-6


@pytest.mark.parametrize("factor", [(1.3, 1.0), (1.0, 1.3), (0.7, 1.0), (1.0, 0.7), (1.2, 0.8)])
def test_each_goes_its_own_way(factor: tuple[float, float]):
    """Only what is wrong moves, down the slope towards the truth, where blocks change one way."""
    signs = (moved(2, (1, 1, 8, 8)) > 0).float() * 2 - 1
    blocks = signs.repeat_interleave(8, 2).repeat_interleave(8, 3)
    change = blocks * moved(0, (1, 1, 64, 64)).abs()
    wrong = [truth * f for truth, f in zip(TRUTH, factor, strict=True)]
    slope = pull(change, counted(change), learned(*wrong))
    for found, f in zip(slope.tolist(), factor, strict=True):
        assert found == pytest.approx(0, abs=1e-6) if f == 1 else found * (f - 1) > 0


def test_a_scene_that_is_a_little_soft_or_misplaced_does_not_move_them():
    """A fit of its light to the counts, pixel by pixel, would make both smaller."""
    coarse = torch.randn(1, 1, 8, 8, generator=generator(0))
    coarse = torch.nn.functional.interpolate(coarse, (96, 96), mode="bilinear")[..., None]
    detail = moved(1, (1, 1, 96, 96))
    events = counted(coarse + detail)
    soft = coarse + 0.5 * detail
    misplaced = (coarse + detail).roll(1, 3)
    for shown in (soft, misplaced):
        thresholds = learned()
        for _ in range(100):
            thresholds.log_factor.data -= 0.1 * pull(shown, events, thresholds)
        assert thresholds.log_factor.abs().max() < 0.04
        light = coarse + detail
        assert (shown * light).sum() / light.square().sum() < 0.8, "as such a fit would have it"


def test_pixels_learn_their_own():
    """Where one pixel's counts are too few, it is its threshold that is asked to grow."""
    change = moved(0, (1, 1, 5, 4)).abs()
    events = counted(change)
    fewer = events.positive.clone()
    fewer[0, 0, 2, 3] /= 2
    thresholds = LearnedThresholds(*TRUTH, pixels=(4, 5))
    assert thresholds.log_pixel is not None
    error = threshold_error(change, replace(events, positive=fewer), thresholds)
    slope = torch.autograd.grad(error, thresholds.log_pixel)[0]
    assert slope[1, 2, 3] < -1e-3
    slope[1, 2, 3] = 0
    assert slope.abs().max() < 1e-6


def test_a_scene_that_does_not_move_asks_for_nothing():
    still = torch.zeros(*SIZE, 1)
    slope = pull(still, counted(moved()), learned())
    assert not slope.any() and slope.isfinite().all()
