"""Thresholds are found where light and events agree."""

import numpy as np
import pytest
import torch

from sharpfield.core.events import EventStream
from sharpfield.core.seed import generator
from sharpfield.events.log_path import LogPath, change_between, exposure_path, pixel_spread
from sharpfield.events.threshold import FixedThresholds
from sharpfield.events.threshold_search import (
    USUAL,
    best_threshold,
    best_thresholds,
    disagreement,
    distance_from_usual,
    edge_density,
)

SIZE, TRUE = 24, FixedThresholds(negative=0.26, positive=0.19)
WINDOWS = [(0, 60_000), (70_000, 130_000)]
MIDDLES = [30_000, 100_000]


def watched() -> tuple[EventStream, torch.Tensor]:
    """Events of a texture that slides by, and its light averaged over two exposures."""
    times = np.arange(0, 130_000, 250)
    y, x = np.mgrid[:SIZE, :SIZE]
    phase = x[None] + times[:, None, None] / 40_000
    log = 0.7 * np.sin(phase) * np.cos(0.3 * y) + 0.3 * np.sin(2.3 * phase + y) - 1.5
    level = log[0].copy()
    columns: list[tuple[int, int, int, int]] = []
    for t, now in zip(times, log, strict=True):
        for sign, step in ((1, TRUE.positive), (-1, -TRUE.negative)):
            while (fired := sign * (now - level) >= abs(step)).any():
                level[fired] += step
                columns += [(u, v, int(t), sign) for v, u in np.argwhere(fired)]
    u, v, t, p = np.array(columns).T
    order = np.argsort(t, kind="stable")
    events = EventStream(
        u[order].astype(np.int16), v[order].astype(np.int16), t[order],
        p[order].astype(np.int8), SIZE, SIZE,
    )  # fmt: skip
    light = [np.exp(log[(times >= a) & (times < b)]).mean(0) for a, b in WINDOWS]
    return events, torch.tensor(np.stack(light), dtype=torch.float32)[..., None]


def test_disagreement_finds_the_threshold_of_each_sign() -> None:
    events, light = watched()
    spread = pixel_spread(width=SIZE, height=SIZE)
    usable = torch.ones_like(light, dtype=torch.bool)

    def cost(tried: FixedThresholds) -> float:
        paths = [
            exposure_path(events, window, np.array([middle]), tried, spread)
            for window, middle in zip(WINDOWS, MIDDLES, strict=True)
        ]
        gap = change_between(events, (MIDDLES[0], MIDDLES[1]), tried, spread)
        return disagreement(light, paths, gap[None], usable)

    found = best_thresholds(cost)
    assert found.negative == pytest.approx(TRUE.negative, rel=0.06)
    assert found.positive == pytest.approx(TRUE.positive, rel=0.06)
    assert cost(found) < 0.5 * cost(FixedThresholds(0.05, 0.05))


def test_exposures_that_agree_cost_nothing_whatever_their_gain() -> None:
    g = generator(0, 0, "cost")
    change, mean = torch.randn(2, 3, 4, 1, generator=g), torch.randn(2, 3, 4, 1, generator=g)
    log = torch.randn(2, 3, 4, 1, generator=g)
    for still in (change, mean):
        still[:, 0] = 0  # the top row sees no events
    log[1, 0] = log[0, 0]
    paths = [LogPath(mean[i], change[i][None]) for i in range(2)]
    light = torch.exp(log + mean - change) * torch.tensor([1.0, 1.7])[:, None, None, None]
    everywhere = torch.ones_like(light, dtype=torch.bool)
    assert disagreement(light, paths, log.diff(dim=0), everywhere) < 2e-3
    assert disagreement(light, paths, log.diff(dim=0) + change[:1], everywhere) > 0.1


def test_pixels_that_cannot_be_used_do_not_count() -> None:
    still = [LogPath(torch.zeros(1, 4, 1), torch.zeros(1, 1, 4, 1))] * 2
    light = torch.tensor([[0.5, 0.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.9]])[:, None, :, None]
    usable = torch.tensor([True, True, True, False]).expand(2, 1, 4)[..., None]
    gap = torch.tensor([0.0, 0.0, 0.1, 0.1])[None, None, :, None]
    found = disagreement(light, still, gap, usable)
    assert found == pytest.approx(0.1, abs=1e-6)  # of the third pixel alone
    assert disagreement(light, still, gap, torch.zeros_like(usable)) == float("inf")


def test_edges_are_denser_in_blur_and_in_noise() -> None:
    y, x = np.mgrid[:40, :40]
    sharp = torch.tensor(((x // 8 + y // 8) % 2), dtype=torch.float32)[..., None]
    window = torch.ones(1, 1, 5, 5) / 25
    blurred = torch.nn.functional.conv2d(sharp[..., 0][None, None], window)[0, 0][..., None]
    noisy = sharp + 0.2 * torch.randn(sharp.shape, generator=generator(0, 0, "noise"))
    assert edge_density(sharp) < edge_density(blurred)
    assert edge_density(sharp) < edge_density(noisy)
    left = torch.zeros(40, 40, 1, dtype=torch.bool)
    left[:, :20] = True
    half = torch.cat([sharp[:, :21], noisy[:, 21:]], 1)
    assert edge_density(half, left) == pytest.approx(edge_density(sharp, left))
    assert edge_density(3 * sharp + 1) == pytest.approx(edge_density(sharp))


def test_usual_thresholds_are_not_pulled() -> None:
    assert distance_from_usual(FixedThresholds(USUAL, USUAL)) == 0
    further = distance_from_usual(FixedThresholds(2 * USUAL, 2 * USUAL))
    assert further == pytest.approx(distance_from_usual(FixedThresholds(USUAL / 2, USUAL / 2)))
    assert further > 0.01


@pytest.mark.parametrize("lowest", [0.03, 0.2, 0.9])
def test_search_finds_the_lowest_cost_in_the_range(lowest: float) -> None:
    found = best_threshold(lambda tried: abs(np.log(tried.positive / lowest)))
    assert found.positive == found.negative == pytest.approx(lowest, rel=0.03)


def test_search_finds_a_threshold_for_each_sign() -> None:
    found = best_thresholds(
        lambda tried: np.log(tried.positive / 0.25) ** 2 + np.log(tried.negative / 0.2) ** 2
    )
    assert (found.negative, found.positive) == pytest.approx((0.2, 0.25), rel=0.05)
