"""What must be true of any sensor, whatever scene it looks at."""

from dataclasses import replace

import pytest
import torch

from sharpfield.core.rays import Rays
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma
from sharpfield.formation.events import LogContrast
from sharpfield.formation.ray_kernels import RigidKernel, RigidMotions, SparseKernel, SparsePoints
from sharpfield.formation.response import FixedResponse, LearnedResponse, LogResidual
from sharpfield.formation.shutter import Pinhole, Shutter
from tests.formation.toy import CAMERA, lit, pairs, pixels, still, swaying, wall


def residual(inputs: str) -> LogResidual:
    made = LogResidual(inputs=inputs, generator=generator(0, 0, "response"))
    with torch.no_grad():
        made.heights += 0.2
    return made


FRAMES = {
    "pinhole": lambda path, **tone: Pinhole(CAMERA, path, **tone),
    "shutter": lambda path, **tone: Shutter(CAMERA, path, 6, **tone),
    "rigid": lambda path, **tone: RigidKernel(
        CAMERA, path, RigidMotions(3, generator=generator(0, 0, "law")), **tone
    ),
    "sparse": lambda path, **tone: SparseKernel(
        CAMERA, path, SparsePoints(3, CAMERA.size, generator=generator(0, 0, "law")), **tone
    ),
}
RESPONSES = {
    "linear": FixedResponse(),
    "gamma": FixedResponse(gamma),
    "learned": LearnedResponse(inputs="light"),
    "learned, polarity": LearnedResponse(polarity_start="random", steps=100),
    "residual": residual("light"),
    "residual, polarity": residual("light+polarity"),
}
frames = pytest.mark.parametrize("frame", FRAMES)
responses = pytest.mark.parametrize("response", RESPONSES)


def sensor(response: str, path=None) -> LogContrast:
    return LogContrast(CAMERA, path or swaying(), RESPONSES[response])


def seen_change(contrast: LogContrast, seen) -> torch.Tensor:
    return contrast.observe(wall(contrast.expose(seen)), seen)


def fog(rays: Rays, light: float = 0.3):
    """The same light from everywhere."""
    return lit(torch.full((*rays.shape, 3), light), rays.weight)


def test_a_still_camera_blurs_nothing():
    seen = pixels()
    blurred, sharp = (FRAMES[name](still(), tone=gamma) for name in ("shutter", "pinhole"))
    torch.testing.assert_close(
        blurred.observe(wall(blurred.expose(seen)), seen),
        sharp.observe(wall(sharp.expose(seen)), seen),
    )


@frames
def test_weights_of_a_pixel_sum_to_one(frame):
    torch.testing.assert_close(
        FRAMES[frame](swaying()).expose(pixels()).weight.sum(1), torch.ones(7)
    )


@frames
def test_even_light_stays_even_under_any_blur(frame):
    sensor = FRAMES[frame](swaying(), tone=gamma)
    observed = sensor.observe(fog(sensor.expose(pixels())), pixels())
    torch.testing.assert_close(observed, gamma(torch.full((7, 3), 0.3)))


@frames
def test_twice_the_light_is_twice_the_measurement(frame):
    sensor = FRAMES[frame](swaying())
    light = wall(sensor.expose(pixels()))
    torch.testing.assert_close(
        sensor.observe(replace(light, rgb=2 * light.rgb), pixels()),
        2 * sensor.observe(light, pixels()),
    )


@frames
def test_pixels_do_not_know_of_each_other(frame):
    sensor = FRAMES[frame](swaying())
    alone = sensor.observe(wall(sensor.expose(pixels()[2:4])), pixels()[2:4])
    torch.testing.assert_close(alone, sensor.observe(wall(sensor.expose(pixels())), pixels())[2:4])


@responses
def test_weights_of_an_event_pair_sum_to_zero(response):
    assert (sensor(response).expose(pairs()).weight.sum(1) == 0).all()


@responses
def test_even_light_makes_no_events(response):
    contrast = sensor(response)
    assert contrast.observe(fog(contrast.expose(pairs())), pairs()).abs().max() == 0


@responses
def test_a_still_camera_sees_no_events(response):
    assert seen_change(sensor(response, still()), pairs()).abs().max() == 0


@responses
@pytest.mark.parametrize("bayer", [False, True])
def test_swapping_the_ends_flips_the_sign(response, bayer):
    seen = pairs(bayer=bayer)
    swapped = replace(seen, start=seen.end, end=seen.start)
    change = seen_change(sensor(response), seen)
    assert change.abs().min() > 1e-4
    torch.testing.assert_close(seen_change(sensor(response), swapped), -change)


@responses
@pytest.mark.parametrize("bayer", [False, True])
def test_events_add_up_over_time(response, bayer):
    """[a, b] and [b, c] make [a, c]; a response that reads counts reads the same ones in all."""
    whole = pairs(bayer=bayer)
    middle = whole.start + 0.3 * (whole.end - whole.start)
    parts = replace(whole, end=middle), replace(whole, start=middle)
    first, second = (seen_change(sensor(response), part) for part in parts)
    torch.testing.assert_close(first + second, seen_change(sensor(response), whole))


def test_events_do_not_see_how_bright_the_lamp_is():
    contrast = LogContrast(CAMERA, swaying(), FixedResponse(floor=0.0))
    light = wall(contrast.expose(pairs()))
    torch.testing.assert_close(
        contrast.observe(replace(light, rgb=7 * light.rgb), pairs()),
        contrast.observe(light, pairs()),
    )


def test_gamma_shrinks_the_change_by_its_power():
    linear, bent = (
        LogContrast(CAMERA, swaying(), FixedResponse(c, 0.0)) for c in (lambda x: x, gamma)
    )
    light = wall(linear.expose(pairs()))
    grey = replace(light, rgb=light.rgb.mean(-1, keepdim=True))
    torch.testing.assert_close(bent.observe(grey, pairs()), linear.observe(grey, pairs()) / 2.2)
