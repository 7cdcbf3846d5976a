"""Encodings: order, values, orthonormality."""

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from sharpfield.ops.encoding import frequencies, frequencies_width, spherical_harmonics


def test_frequencies_come_octave_by_octave_sine_first() -> None:
    x = torch.tensor([[0.3, -0.7]], dtype=torch.float64)
    sin, cos = torch.sin, torch.cos
    expected = torch.cat([x, sin(x), cos(x), sin(2 * x), cos(2 * x), sin(4 * x), cos(4 * x)], -1)
    torch.testing.assert_close(frequencies(x, 3), expected)


@pytest.mark.parametrize(("coordinates", "octaves", "width"), [(3, 10, 63), (3, 4, 27), (3, 0, 3)])
def test_published_widths(coordinates: int, octaves: int, width: int) -> None:
    assert frequencies(torch.zeros(5, coordinates), octaves).shape == (5, width)
    assert frequencies_width(coordinates, octaves) == width


def directions(n: int) -> torch.Tensor:
    rng = np.random.default_rng(0)
    return torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(n, 3))), dim=-1)


def test_spherical_harmonics_match_scipy() -> None:
    direction = directions(50)
    x, y, z = direction.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    expected = []
    for degree in range(5):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth) * (-1.0) ** order
            if order == 0:
                expected.append(value.real)
            else:
                expected.append(np.sqrt(2) * (value.imag if order < 0 else value.real))
    found = spherical_harmonics(direction, 4).numpy()
    np.testing.assert_allclose(found, np.stack(expected, -1), atol=1e-12)


@pytest.mark.parametrize("degree", range(5))
def test_band_energy_does_not_depend_on_direction(degree: int) -> None:
    found = spherical_harmonics(directions(50), degree)
    expected = torch.full((50,), (degree + 1) ** 2 / (4 * np.pi), dtype=torch.float64)
    torch.testing.assert_close(found.square().sum(-1), expected)


@pytest.mark.parametrize("encode", [frequencies, spherical_harmonics])
def test_gradients(encode) -> None:
    x = directions(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: encode(x, 4), (x,))


def test_degree_beyond_four_is_refused() -> None:
    with pytest.raises(ValueError, match="degree must be 0 to 4, not 5"):
        spherical_harmonics(directions(1), 5)
