"""Tone curves: how a frame stores linear light, and how to get the light back.

*Encode* takes linear light to stored values, *decode* stored values to linear light; both run
from 0...1 to 0...1, and go on beyond both ends without NaN. The names are those of
`Frames.encoding`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.errors import expect_one_of

Curve = Callable[[Tensor], Tensor]
"""Light in, something else out; one value at a time, or the channels of one ray at a time."""


def identity(light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
    """Light as it is."""
    return light


REC601 = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in luma."""


def luma(image: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
    """Rec. 601 luma of three channels; a single channel as it is.

    Of display values it is their brightness; of linear light, what a pixel without a colour filter
    measures.
    """
    if image.shape[-1] == 1:
        return image[..., 0]
    return (image * image.new_tensor(REC601)).sum(-1)  # ITU-R BT.601


GAMMA = 2.2

GAMMA_TOE = 1e-5
"""Linear light below which the gamma curve is a straight line.

A power of 1/2.2 has infinite slope at 0. The line differs from it by less than half a step of 8
bits.
"""

GAMMA_SLOPE = GAMMA_TOE ** (1 / GAMMA - 1)

SRGB_TOE, SRGB_SLOPE, SRGB_POWER, SRGB_OFFSET = 0.0031308, 12.92, 2.4, 0.055


@dataclass(frozen=True)
class Tone:
    """A tone curve and its inverse."""

    encode: Curve
    """Linear light to stored values."""
    decode: Curve
    """Stored values to linear light."""


def gamma(light: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """light^(1/2.2), with a straight toe of finite slope."""
    power = light.clamp_min(GAMMA_TOE) ** (1 / GAMMA)
    return torch.where(light < GAMMA_TOE, GAMMA_SLOPE * light, power)


def gamma_inverse(stored: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The exact inverse of `gamma`."""
    toe = GAMMA_SLOPE * GAMMA_TOE
    return torch.where(stored < toe, stored / GAMMA_SLOPE, stored.clamp_min(toe) ** GAMMA)


def srgb(light: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The transfer function of IEC 61966-2-1."""
    power = light.clamp_min(SRGB_TOE) ** (1 / SRGB_POWER)
    bent = (1 + SRGB_OFFSET) * power - SRGB_OFFSET
    return torch.where(light < SRGB_TOE, SRGB_SLOPE * light, bent)


def srgb_inverse(stored: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The inverse of `srgb`."""
    toe = SRGB_SLOPE * SRGB_TOE
    straight = (stored.clamp_min(toe) + SRGB_OFFSET) / (1 + SRGB_OFFSET)
    return torch.where(stored < toe, stored / SRGB_SLOPE, straight**SRGB_POWER)


TONES = {
    "linear": Tone(identity, identity),
    "gamma2.2": Tone(gamma, gamma_inverse),
    "srgb": Tone(srgb, srgb_inverse),
}
"""By the name of the encoding."""


def tone_of(encoding: str) -> Tone:
    """The tone curve of frames stored in an encoding.

    Raises:
        OptionError: There is no such encoding.
    """
    expect_one_of("tone curve", encoding, TONES)
    return TONES[encoding]
