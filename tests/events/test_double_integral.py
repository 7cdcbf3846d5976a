"""The event double integral: published numbers, closed forms, agreement of exposures."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.seed import generator
from sharpfield.core.tone import tone_of
from sharpfield.events import double_integral as edi
from sharpfield.events.log_path import LogPath, exposure_path, pixel_spread
from sharpfield.events.threshold import FixedThresholds

GOLDEN_SLICES = [0.2, 0, -0.2, 0.2, 0.2, 0, 0.2, -0.2]


def pixel(values: list[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None, None, None]


def events_of(t_us: list[int], p: list[int], x: list[float] | None = None) -> EventStream:
    n = len(t_us)
    column = np.zeros(n, np.int16) if x is None else np.array(x, np.float32)
    return EventStream(
        column, np.zeros(n, column.dtype), np.array(t_us), np.array(p, np.int8), width=3, height=1
    )


def test_golden_numbers() -> None:
    path = edi.path_of_instants(pixel(GOLDEN_SLICES))
    offsets = (path.change - path.change[4])[:, 0, 0, 0]
    expected = torch.tensor([-0.2, 0, 0, -0.2, 0, 0.2, 0.2, 0.4, 0.2], dtype=torch.float64)
    torch.testing.assert_close(offsets, expected)
    sharp = edi.latent(torch.full((1, 1, 3), 0.5, dtype=torch.float64), path, 4)
    torch.testing.assert_close(sharp, torch.full_like(sharp, 0.459488695), rtol=0, atol=5e-10)


def test_average_of_all_latents_is_the_blurred_image() -> None:
    slices = torch.randn(8, 3, 4, 1, generator=generator(0, 0, "slices"), dtype=torch.float64)
    path = edi.path_of_instants(slices)
    blurred = torch.rand(3, 4, 3, generator=generator(0, 0, "blur"), dtype=torch.float64)
    sharp = torch.stack([edi.latent(blurred, path, k) for k in range(9)])
    torch.testing.assert_close(sharp.mean(0), blurred)


def test_without_events_nothing_changes() -> None:
    blurred = torch.rand(3, 4, 3, generator=generator(0, 0, "blur"))
    still = LogPath(torch.zeros(3, 4, 1), torch.zeros(1, 3, 4, 1))
    assert torch.equal(edi.latent(blurred, still, 0), blurred)
    tone = tone_of("gamma2.2")
    torch.testing.assert_close(edi.latent_in_light(blurred, still, 0, tone), blurred)


def test_published_slices_count_events_on_inner_borders_twice() -> None:
    thresholds = FixedThresholds(negative=0.3, positive=0.2)
    events = events_of([0, 100, 150, 200, 800, 801], [1, 1, -1, -1, 1, 1])
    slices = edi.published_slices(events, (0, 800), thresholds)[:, 0, 0, 0]
    # Borders every 100 us: 0 and 800 count once, 100 and 200 twice, 801 is outside.
    expected = torch.tensor([0.4, 0.2 - 0.3 - 0.3, -0.3, 0, 0, 0, 0, 0.2])
    torch.testing.assert_close(slices, expected)


def test_published_image_is_the_formula_on_stored_values() -> None:
    thresholds = FixedThresholds(0.2, 0.2)
    times = [50, 250, 350, 450, 650, 750]
    events = events_of(times, [1, -1, 1, 1, 1, -1])
    stored = torch.full((1, 3, 3), 0.5)
    found = edi.published(stored, events, (0, 800), thresholds)
    torch.testing.assert_close(found[0, 0], torch.full((3,), 0.459488695), rtol=0, atol=1e-6)
    torch.testing.assert_close(found[0, 1:], stored[0, 1:])


def test_published_image_is_not_clipped() -> None:
    events = events_of([100] * 9, [1] * 9)
    found = edi.published(torch.full((1, 3, 3), 0.9), events, (0, 800), FixedThresholds(0.2, 0.2))
    assert found.max() > 1


def test_published_slices_share_rectified_events() -> None:
    events = events_of([10, 20], [1, 1], x=[0.25, 2.5])
    slices = edi.published_slices(events, (0, 800), FixedThresholds(0.2, 0.2))
    torch.testing.assert_close(slices[0, 0, :, 0], torch.tensor([0.15, 0.05, 0.1]))


@pytest.mark.parametrize("rise", [-3.0, -1e-3, 0.0, 1e-6, 0.5, 20.0])
def test_slices_integrate_a_broken_line_exactly(rise: float) -> None:
    path = edi.path_of_slices(pixel([rise, -0.4]))
    fine = np.concatenate([np.linspace(0, rise, 20001), np.linspace(rise, rise - 0.4, 20001)])
    middles = (np.exp(fine[1:]) + np.exp(fine[:-1])) / 2
    middles = np.delete(middles, 20000)
    assert path.log_mean.item() == pytest.approx(np.log(middles.mean()), abs=1e-6)


def test_latents_at_several_instants_follow_the_events() -> None:
    events = events_of([200, 600], [1, -1])
    spread = pixel_spread(width=3, height=1)
    path = exposure_path(
        events, (0, 800), np.array([100, 400, 700]), FixedThresholds(0.3, 0.2), spread
    )
    sharp = torch.stack([edi.latent(torch.ones(1, 3, 1), path, k)[0, 0, 0] for k in range(3)])
    torch.testing.assert_close(sharp.log().diff(), torch.tensor([0.2, -0.3]))


def slow_joint(alone: np.ndarray, gaps: np.ndarray, trust: float) -> np.ndarray:
    n = len(alone)
    rows, right = [], []
    for i in range(n):
        rows.append(np.eye(n)[i])
        right.append(alone[i])
    for i in range(n - 1):
        rows.append(np.sqrt(trust) * (np.eye(n)[i + 1] - np.eye(n)[i]))
        right.append(np.sqrt(trust) * gaps[i])
    return np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]


@pytest.mark.parametrize("n", [1, 2, 6])
@pytest.mark.parametrize("trust", [1.0, 0.1])
def test_joint_latents_are_the_least_squares_solution(n: int, trust: float) -> None:
    g = generator(0, 0, "joint")
    alone = torch.randn(n, 2, 3, 1, generator=g, dtype=torch.float64)
    gaps = torch.randn(n - 1, 2, 3, 1, generator=g, dtype=torch.float64)
    found = edi.joint_latents(alone, gaps, trust=trust)
    for y in range(2):
        for x in range(3):
            expected = slow_joint(alone[:, y, x, 0].numpy(), gaps[:, y, x, 0].numpy(), trust)
            np.testing.assert_allclose(found[:, y, x, 0], expected, atol=1e-12)


def test_exposures_that_agree_are_left_alone() -> None:
    alone = torch.randn(5, 2, 3, 1, generator=generator(0, 0, "joint"), dtype=torch.float64)
    torch.testing.assert_close(edi.joint_latents(alone, alone.diff(dim=0), trust=3.0), alone)


def test_gradients() -> None:
    alone = torch.randn(3, 1, 2, 1, dtype=torch.float64, generator=generator(0, 0, "a"))
    gaps = torch.randn(2, 1, 2, 1, dtype=torch.float64, generator=generator(0, 0, "g"))
    inputs = alone.requires_grad_(), gaps.requires_grad_()
    assert torch.autograd.gradcheck(edi.joint_latents, inputs)

    def sharp(slices: torch.Tensor) -> torch.Tensor:
        path = edi.path_of_slices(slices)
        return edi.latent(torch.ones(1, 2, 1, dtype=torch.float64), path, 1)

    assert torch.autograd.gradcheck(sharp, (gaps,))


def test_stored_values_are_decoded_first() -> None:
    events = events_of([500], [1])
    light = torch.tensor([1.5 * 0.2, 0.4, 0.1])[None, :, None]
    tone = tone_of("srgb")
    sharp = edi.edi(
        tone.encode(light),
        events,
        (0, 1000),
        instants_us=[0, 1000],
        threshold=(0.5, math.log(2)),
        encoding="srgb",
    )
    expected = torch.tensor([[0.2, 0.4, 0.1], [0.4, 0.4, 0.1]])[:, None, :, None]
    torch.testing.assert_close(tone.decode(sharp), expected)


def test_coloured_events_are_refused() -> None:
    with pytest.raises(OptionError, match="one mono camera"):
        edi.edi(torch.zeros(1, 3, 1), replace(events_of([1], [1]), bayer="RGGB"), (0, 10))
