import pytest
import torch

from sharpfield.core.errors import OptionError
from sharpfield.core.frames import ENCODINGS
from sharpfield.core.tone import GAMMA_TOE, TONES, gamma, srgb, tone_of

LIGHT = torch.cat([torch.logspace(-9, 0, 200, dtype=torch.float64), torch.tensor([0.0, -0.1, 1.5])])


@pytest.mark.parametrize("encoding", TONES)
def test_decode_undoes_encode(encoding):
    tone = tone_of(encoding)
    torch.testing.assert_close(tone.decode(tone.encode(LIGHT)), LIGHT.double())


@pytest.mark.parametrize("encoding", TONES)
def test_black_stays_black_and_white_stays_white(encoding):
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(tone_of(encoding).encode(ends), ends)


@pytest.mark.parametrize("encoding", TONES)
def test_it_rises_everywhere(encoding):
    stored = tone_of(encoding).encode(LIGHT.sort().values)
    assert (stored.diff() > 0).all()


def test_every_encoding_of_frames_has_a_tone():
    assert set(TONES) == set(ENCODINGS)


def test_gamma_is_the_power_to_within_half_a_step_of_8_bits():
    light = torch.linspace(0, 1, 100_001, dtype=torch.float64)
    power = light ** (1 / 2.2)
    assert (gamma(light) - power).abs().max() < 0.5 / 255
    beyond = light > GAMMA_TOE
    torch.testing.assert_close(gamma(light)[beyond], power[beyond])


def test_srgb_of_published_values():
    light = torch.tensor([0.0031308, 0.18, 0.5], dtype=torch.float64)
    expected = torch.tensor([0.0404499, 0.4613561, 0.7353569], dtype=torch.float64)
    torch.testing.assert_close(srgb(light), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("encoding", ["gamma2.2", "srgb"])
def test_gradients(encoding):
    tone = tone_of(encoding)
    light = torch.tensor([1e-6, 1e-3, 0.2, 1.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(tone.encode, light, eps=1e-8)
    assert torch.autograd.gradcheck(tone.decode, light)


@pytest.mark.parametrize("encoding", TONES)
def test_slope_at_black_is_finite(encoding):
    light = torch.tensor([-1.0, 0.0], requires_grad=True)
    tone_of(encoding).encode(light).sum().backward()
    assert light.grad is not None and light.grad.isfinite().all() and (light.grad > 0).all()


def test_an_unknown_encoding_is_named():
    with pytest.raises(OptionError) as wrong:
        tone_of("log")
    assert str(wrong.value) == (
        "OptionError: unknown tone curve\n  got    log\n  do     use one of linear, gamma2.2, srgb"
    )
