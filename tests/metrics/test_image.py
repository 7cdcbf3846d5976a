import jaxtyping
import pytest
import torch
from torch import Tensor

from sharpfield.core.errors import ShapeError
from sharpfield.metrics.image import psnr, ssim, ssim_paper, ssim_uniform

SSIMS = [ssim, ssim_uniform, ssim_paper]


def waves() -> tuple[Tensor, Tensor]:
    """The closed-form pair of images behind the published check values."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    y, x = y.double(), x.double()
    truth = torch.stack([0.5 + 0.4 * (x / 7 + c).sin() * (y / (9 + c)).cos() for c in range(3)], -1)
    return (0.95 * truth + 0.02 + 0.03 * (x / 3).cos()[..., None]).clamp(0, 1), truth


def noisy(channels: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    truth = torch.rand(40, 52, channels, generator=generator)
    return (truth + 0.1 * torch.randn(truth.shape, generator=generator)).clamp(0, 1), truth


# laws


@pytest.mark.parametrize("measure", SSIMS)
def test_a_image_is_like_itself(measure):
    _, truth = noisy()
    assert measure(truth, truth).item() == pytest.approx(1)


@pytest.mark.parametrize("measure", [psnr, *SSIMS])
def test_order_does_not_matter(measure):
    a, b = noisy()
    assert measure(a, b).item() == pytest.approx(measure(b, a).item())


def test_psnr_of_a_constant_error():
    grey = torch.full((4, 5, 3), 0.5)
    assert psnr(grey + 0.1, grey).item() == pytest.approx(20, abs=1e-4)


def test_psnr_of_equal_images_is_infinite():
    assert psnr(torch.ones(2, 2, 1), torch.ones(2, 2, 1)).isinf()


# golden numbers, in float64 from independent code


@pytest.mark.parametrize(
    ("measure", "golden"), [(psnr, 32.376791), (ssim_uniform, 0.972995), (ssim_paper, 0.875933)]
)
def test_golden_numbers(measure, golden):
    assert measure(*waves()).item() == pytest.approx(golden, abs=1e-6)


def test_the_definitions_differ():
    values = [measure(*waves()).item() for measure in SSIMS]
    assert max(values) - min(values) > 0.05 and len({round(v, 4) for v in values}) == 3


# oracles


@pytest.mark.parametrize("pair", [waves, noisy, lambda: noisy(1)])
def test_scikit_image_agrees(pair):
    metrics = pytest.importorskip("skimage.metrics")
    a, b = (one.double().numpy() for one in pair())
    gaussian = metrics.structural_similarity(
        b,
        a,
        data_range=1,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    uniform = metrics.structural_similarity(b, a, data_range=1, channel_axis=-1)
    paper = metrics.structural_similarity(2 * b - 1, 2 * a - 1, data_range=2, channel_axis=-1)
    for measure, wanted in zip(SSIMS, (gaussian, uniform, paper), strict=True):
        assert measure(*pair()).item() == pytest.approx(wanted, abs=1e-7)
    wanted = metrics.peak_signal_noise_ratio(b, a, data_range=1)
    assert psnr(*pair()).item() == pytest.approx(wanted, abs=1e-6)


def test_torchmetrics_agrees():
    image = pytest.importorskip("torchmetrics.functional.image")
    a, b = (one.double().permute(2, 0, 1)[None] for one in noisy())
    # Its mean counts windows that hang over the border (filled by reflection); ours does not.
    _, everywhere = image.structural_similarity_index_measure(
        a, b, data_range=1.0, return_full_image=True
    )
    assert ssim(*noisy()).item() == pytest.approx(everywhere[..., 5:-5, 5:-5].mean().item())
    wanted = image.peak_signal_noise_ratio(a, b, data_range=1.0)
    assert psnr(*noisy()).item() == pytest.approx(wanted.item(), abs=1e-5)


# errors


@pytest.mark.parametrize("measure", [psnr, *SSIMS])
def test_different_shapes_are_refused(measure, monkeypatch: pytest.MonkeyPatch):
    # The shape checker of the tests would speak first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ShapeError, match=r"different shapes[\s\S]*\(20, 20, 3\) and \(20, 21, 3\)"):
        measure(torch.zeros(20, 20, 3), torch.zeros(20, 21, 3))


def test_a_image_smaller_than_the_window_is_refused():
    with pytest.raises(ShapeError, match=r"smaller than the window[\s\S]*12x6 pixels, window 7"):
        ssim_paper(torch.zeros(6, 12, 3), torch.zeros(6, 12, 3))
