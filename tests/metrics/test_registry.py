import pytest
import torch

from sharpfield.metrics.image import psnr
from sharpfield.metrics.registry import METRICS, with_lpips


def test_each_metric_is_one_object():
    assert list(METRICS) == ["psnr", "ssim", "ssim_paper", "lpips"]
    assert all(METRICS[name].name == name for name in METRICS)
    assert [METRICS[name].better for name in METRICS] == ["higher"] * 3 + ["lower"]


def test_values_of_two_images():
    truth = torch.rand(16, 20, 3, generator=torch.Generator().manual_seed(0))
    blurred = truth.lerp(truth.roll(1, 0), 0.3)
    assert METRICS["psnr"].compute(blurred, truth) == pytest.approx(float(psnr(blurred, truth)))
    assert METRICS["psnr"].compute(truth, truth) == 100
    assert METRICS["ssim"].compute(truth, truth) == pytest.approx(1)
    assert METRICS["ssim_paper"].compute(truth, truth) == pytest.approx(1)


def test_lpips_is_computed_only_with_weights():
    assert METRICS["lpips"].compute is None
    metric = with_lpips(lambda image, reference: (image - reference).abs().sum())  # type: ignore
    assert metric.compute(torch.ones(2, 2, 3), torch.zeros(2, 2, 3)) == 12
    assert metric.better == "lower"


def test_printing_and_choosing():
    assert METRICS["psnr"].text(31.239) == "31.24"
    assert METRICS["psnr"].text(None) == "–"
    assert METRICS["psnr"].best([1.0, 3.0]) == 3
    assert METRICS["lpips"].best([1.0, 3.0]) == 1
