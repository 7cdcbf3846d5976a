import pytest
import torch

from sharpfield.evaluation.scores import HIGHEST_PSNR, mean, score


def test_equal_images_have_the_highest_psnr_and_stay_finite():
    image = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    found = score(image, image)
    assert found["psnr"] == HIGHEST_PSNR
    assert found["ssim"] == pytest.approx(1) and found["lpips"] is None


def test_mean_is_over_images_and_none_where_one_lacks_it():
    rows = [
        {"psnr": 20.0, "ssim": 0.5, "ssim_paper": 0.4, "lpips": None},
        {"psnr": 30.0, "ssim": 0.7, "ssim_paper": 0.6, "lpips": 0.1},
    ]
    found = mean(rows)
    assert found == {
        "psnr": 25.0,
        "ssim": pytest.approx(0.6),
        "ssim_paper": pytest.approx(0.5),
        "lpips": None,
    }


def test_mean_of_no_images_is_none():
    assert set(mean([]).values()) == {None}
