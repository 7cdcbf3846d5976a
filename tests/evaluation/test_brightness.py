import pytest
import torch

from sharpfield.evaluation.brightness import Brightness, fit_brightness, fit_log_affine


def images(count: int = 2, channels: int = 3) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [0.05 + 0.9 * torch.rand(9, 7, channels, generator=generator) for _ in range(count)]


def test_the_line_that_made_the_images_is_found_for_each_channel():
    light = images()
    gain, offset = torch.tensor([0.5, 1.0, 2.0]), torch.tensor([-0.1, -0.4, 0.0])
    stored = [(gain * one.log() + offset).exp() for one in light]
    found = fit_log_affine(light, stored)
    torch.testing.assert_close(found.gain, gain, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found.offset, offset, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found(light[1]), stored[1], atol=1e-4, rtol=1e-4)


def test_numpy_finds_the_same_line_through_noise():
    light, stored = images(2, 1), [one.flip(0) * 0.8 for one in images(2, 1)]
    x = torch.cat([one.flatten() for one in light]).log().numpy()
    y = torch.cat([one.flatten() for one in stored]).log().numpy()
    design = torch.stack([torch.from_numpy(x), torch.ones(len(x))], -1)
    wanted = torch.linalg.lstsq(design, torch.from_numpy(y)[:, None]).solution.flatten()
    found = fit_log_affine(light, stored)
    assert found.gain.item() == pytest.approx(wanted[0].item(), rel=1e-4)
    assert found.offset.item() == pytest.approx(wanted[1].item(), rel=1e-4)


def test_light_of_one_brightness_is_only_shifted():
    flat = torch.full((4, 4, 1), 0.3)
    found = fit_log_affine([flat], [torch.full((4, 4, 1), 0.6)])
    assert found.gain.item() == 0
    torch.testing.assert_close(found(flat), torch.full((4, 4, 1), 0.6))


def test_black_pixels_stay_finite():
    found = fit_log_affine([torch.zeros(2, 2, 1)], [torch.rand(2, 2, 1)])
    assert found(torch.zeros(2, 2, 1)).isfinite().all()


def test_without_alignment_the_model_develops():
    brightness = Brightness(lambda light: light * 2)
    assert brightness.image(torch.full((1, 1, 3), 0.4)).tolist() == [[pytest.approx([0.8] * 3)]]
    assert brightness.image(torch.full((1, 1, 3), 0.9)).max() == 1
    assert brightness.stated() is None


def test_without_references_nothing_is_aligned():
    assert fit_brightness(lambda light: light, [], grey=True).aligned is None
