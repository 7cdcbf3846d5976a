"""Brightness left open, and depth up to a scale."""

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.evaluation.scores import DARK, aligned_psnr, distances, scaled_depth_error

CAMERA = Camera(9, 7, 6.0, 6.0, 4.5, 3.5)


def image() -> torch.Tensor:
    return torch.rand(12, 14, 1, generator=torch.Generator().manual_seed(0))


def test_gain_and_offset_of_the_logarithm_cost_nothing():
    truth = image()
    dim = (0.6 * (truth + DARK).log() - 0.4).exp() - DARK
    assert aligned_psnr(dim, truth) == 100
    assert aligned_psnr(truth**2, truth) < 40


def test_a_image_of_one_colour_is_fitted_by_the_mean_logarithm():
    truth = image()
    best = (truth + DARK).log().mean().exp() - DARK
    expected = -10 * float((truth - best).square().mean().log10())
    assert aligned_psnr(torch.full_like(truth, 0.3), truth) == pytest.approx(expected, abs=1e-3)


def test_scale_of_depth_is_left_open_but_common_to_all_views():
    near, far = np.full((3, 4), 2.0, np.float32), np.full((3, 4), 6.0, np.float32)
    solid = [torch.ones(3, 4)] * 2
    drawn = [torch.from_numpy(near) * 5, torch.from_numpy(far) * 5]
    assert scaled_depth_error(drawn, solid, [near, far]) == pytest.approx(0, abs=1e-6)
    assert scaled_depth_error([drawn[0], drawn[0]], solid, [near, far]) > 0.3


def test_only_pixels_with_a_true_depth_count_and_clear_ones_count_as_missed():
    truth = np.array([[1.0, 2.0, np.inf, 0.0]], np.float32)
    drawn = [torch.tensor([[1.0, 2.0, 9.0, 9.0]])]
    assert scaled_depth_error(drawn, [torch.ones(1, 4)], [truth]) == pytest.approx(0)
    clear = torch.tensor([[1.0, 0.2, 1.0, 1.0]])
    assert scaled_depth_error(drawn, [clear], [truth]) == pytest.approx(0.5)
    assert scaled_depth_error(drawn, [0 * clear], [truth]) == 1
    assert scaled_depth_error(drawn, [clear], [np.full((1, 4), np.inf, np.float32)]) is None


def test_errors_of_a_pixel_are_at_most_one():
    truth = np.ones((1, 5), np.float32)
    drawn = [torch.tensor([[1.0, 1.0, 1.0, 1.0, 100.0]])]
    assert scaled_depth_error(drawn, [torch.ones(1, 5)], [truth]) == pytest.approx(0.2)


def test_distance_is_depth_in_the_middle_and_more_at_the_border():
    found = distances(np.full((7, 9), 2.0, np.float32), CAMERA)
    assert found[3, 4] == pytest.approx(2)
    assert found[0, 0] == pytest.approx(2 * np.sqrt(1 + (4 / 6) ** 2 + (3 / 6) ** 2))
