import numpy as np
import pytest
from scipy.ndimage import convolve

from sharpfield.core.errors import OptionError
from sharpfield.simulation.sensors.motion_blur import (
    DrawnBlur,
    KernelRange,
    blurred,
    drawn_blur,
    motion_kernel,
)


def draw(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("k", [3, 8, 15, 60])
@pytest.mark.parametrize("phi", [0.0, 0.1, 1.0])
def test_kernels_sum_to_one_and_are_never_negative(k, phi):
    for seed in range(20):
        kernel = motion_kernel(k, phi, draw(seed))
        assert kernel.shape == (k, k) and kernel.min() >= 0
        assert kernel.sum() == pytest.approx(1, abs=1e-5)


def test_strokes_are_nearly_straight_for_small_intensities():
    def crookedness(phi):
        """Spread across the stroke over that along it."""
        ratios = []
        for seed in range(40):
            kernel = motion_kernel(31, phi, draw(seed)).astype(float)
            places = np.indices(kernel.shape).reshape(2, -1)
            small, large = np.linalg.eigvalsh(np.cov(places, aweights=kernel.ravel(), ddof=0))
            ratios.append(small / max(large, 1e-9))
        return np.median(ratios)

    assert crookedness(0.02) < 0.05 < crookedness(1.0)


def test_expected_lengths_are_as_published():
    """0.75 of the diagonal at most, uniform: about 1.06 k times a number from 0 to 1."""
    lengths = []
    for seed in range(150):
        kernel = motion_kernel(15, 0.05, draw(seed))
        lengths.append(DrawnBlur(15, 0.05, kernel).length_px)
    assert 0.4 * 15 < np.mean(lengths) < 0.75 * 15
    assert max(lengths) < 1.5 * 15


def test_an_even_line_is_as_long_as_it_looks():
    kernel = np.zeros((15, 15), np.float32)
    kernel[7, 2:12] = 0.1
    assert DrawnBlur(15, 0.0, kernel).length_px == pytest.approx(10, rel=0.01)
    point = np.zeros((3, 3), np.float32)
    point[1, 1] = 1
    assert DrawnBlur(3, 0.0, point).length_px == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("k", [5, 6])
def test_blur_is_convolution_and_keeps_size_and_brightness(k):
    kernel = motion_kernel(k, 0.5, draw(3))
    image = draw(1).integers(0, 256, (20, 24, 3)).astype(np.uint8)
    made = blurred(image, kernel)
    assert made.shape == image.shape and made.dtype == np.uint8
    origin = 0 if k % 2 else -1  # of scipy's kernels of even size
    for channel in range(3):
        slow = convolve(
            image[..., channel].astype(float), kernel.astype(float), mode="nearest", origin=origin
        )
        np.testing.assert_allclose(made[..., channel], slow, atol=0.51)
    even = np.full((9, 9, 1), 40_000, np.uint16)
    np.testing.assert_array_equal(blurred(even, kernel), even)


def test_the_share_of_blurred_images_is_as_told():
    ranges = KernelRange((3, 16), (0.0, 0.1), 0.75)
    drawn = [drawn_blur(ranges, draw(seed)) for seed in range(400)]
    made = [one for one in drawn if one is not None]
    assert 0.68 < len(made) / 400 < 0.82
    assert {one.k for one in made} == set(range(3, 16))
    assert all(0 <= one.phi <= 0.1 for one in made)
    none, every = KernelRange(probability=0.0), KernelRange(probability=1.0)
    assert all(drawn_blur(none, draw(seed)) is None for seed in range(20))
    assert all(drawn_blur(every, draw(seed)) is not None for seed in range(20))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"k": (2, 16)}, "at least 3 and rise"),
        ({"k": (8, 8)}, "at least 3 and rise"),
        ({"phi": (0.2, 0.1)}, "between 0 and 1 and rise"),
        ({"probability": 1.5}, "a probability must lie between 0 and 1"),
    ],
)
def test_impossible_ranges(wrong, message):
    with pytest.raises(OptionError, match=message):
        KernelRange(**wrong)
