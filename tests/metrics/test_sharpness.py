import cv2
import numpy as np
import pytest
import torch

from sharpfield.core.tone import luma
from sharpfield.metrics.image import gradient_energy, laplacian_variance


def noise(channels: int = 3) -> torch.Tensor:
    return torch.rand(30, 40, channels, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("measure", [laplacian_variance, gradient_energy])
def test_a_flat_image_has_no_sharpness_and_blur_lowers_it(measure):
    image = noise()
    blurred = torch.from_numpy(cv2.GaussianBlur(image.numpy(), (5, 5), 1.0))
    assert measure(torch.full((9, 9, 3), 0.3)).item() == pytest.approx(0, abs=1e-12)
    assert measure(blurred) < 0.5 * measure(image)


@pytest.mark.parametrize("measure", [laplacian_variance, gradient_energy])
def test_twice_the_contrast_is_four_times_the_energy(measure):
    assert measure(noise() * 2).item() == pytest.approx(4 * measure(noise()).item(), rel=1e-5)


def test_opencv_agrees():
    image = noise(1)
    wanted = cv2.Laplacian(image[..., 0].double().numpy(), cv2.CV_64F)[1:-1, 1:-1].var()
    assert laplacian_variance(image).item() == pytest.approx(wanted)


def test_gradient_of_a_ramp_is_its_slope():
    ramp = torch.from_numpy(np.fromfunction(lambda y, x: 0.3 * x + 0.4 * y, (6, 7)))
    assert gradient_energy(ramp[..., None]).item() == pytest.approx(0.25)


def test_luma_weighs_channels_and_passes_grey():
    assert luma(torch.tensor([1.0, 0.0, 1.0])).item() == pytest.approx(0.413)
    assert luma(torch.tensor([[0.7]])).tolist() == pytest.approx([0.7])
