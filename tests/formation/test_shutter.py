import pytest
import torch

from sharpfield.core.protocols import Formation
from sharpfield.core.seed import generator
from sharpfield.core.tone import gamma
from sharpfield.formation.shutter import Pinhole, Shutter
from tests.formation.toy import CAMERA, pixels, still, swaying, wall


def test_both_are_formations():
    assert isinstance(Pinhole(CAMERA, still()), Formation)
    assert isinstance(Shutter(CAMERA, still(), 3), Formation)


def test_a_still_camera_blurs_nothing():
    seen = pixels()
    blurred, sharp = Shutter(CAMERA, still(), 5, gamma), Pinhole(CAMERA, still(), gamma)
    torch.testing.assert_close(
        blurred.observe(wall(blurred.expose(seen)), seen),
        sharp.observe(wall(sharp.expose(seen)), seen),
    )


def test_weights_are_equal_and_sum_to_one():
    weight = Shutter(CAMERA, swaying(), 7).expose(pixels()).weight
    torch.testing.assert_close(weight, torch.full_like(weight, 1 / 7))


def test_one_sample_is_the_pinhole():
    seen = pixels()
    one, pinhole = Shutter(CAMERA, swaying(), 1).expose(seen), Pinhole(CAMERA, swaying())
    for name in ("origin", "direction", "time", "weight"):
        torch.testing.assert_close(getattr(one, name), getattr(pinhole.expose(seen), name))


def test_it_is_the_mean_of_light_at_the_middles_of_equal_parts():
    seen, path = pixels(), swaying()
    shutter = Shutter(CAMERA, path, 4, gamma)
    observed = shutter.observe(wall(shutter.expose(seen)), seen)
    for b in range(len(seen)):
        light = torch.zeros(3)
        for k in range(4):
            time = seen.open[b] + (seen.close[b] - seen.open[b]) * (k + 0.5) / 4
            pose = path.pose(time[None], seen.track[b : b + 1])[0]
            direction = pose[:, :3] @ CAMERA.direction(seen.xy[b])
            reach = (3 - pose[2, 3]) / direction[2]
            x, y, _ = pose[:, 3] + reach * direction
            light += 0.5 + 0.4 * torch.stack([(2 * x + y).sin(), (3 * y).cos(), (x - 2 * y).sin()])
        torch.testing.assert_close(observed[b], gamma(light / 4), atol=1e-5, rtol=0)


def test_the_error_falls_with_the_square_of_the_samples():
    seen, path = pixels(40), swaying()

    def blurred(samples: int) -> torch.Tensor:
        shutter = Shutter(CAMERA, path, samples)
        return shutter.observe(wall(shutter.expose(seen)), seen)

    exact = blurred(600)
    errors = [(blurred(n) - exact).abs().max() for n in (4, 8)]
    assert errors[1] < errors[0] / 3


def test_the_middle_sample_of_an_odd_number_is_the_middle_of_the_exposure():
    seen = pixels()
    time = Shutter(CAMERA, swaying(), 9).expose(seen).time
    torch.testing.assert_close(time[:, 4], seen.middle)


def test_jitter_stays_in_its_part_and_depends_on_the_generator_alone():
    seen = pixels(50)
    shutter = Shutter(CAMERA, swaying(), 6)
    time = shutter.expose(seen, generator(1, 0, "shutter")).time
    part = (time - seen.open[:, None]) / 0.2 * 6
    assert ((part - torch.arange(6)).clamp(0, 1) - (part - torch.arange(6))).abs().max() < 1e-4
    assert (time - shutter.expose(seen).time).abs().max() > 0.01
    assert torch.equal(time, shutter.expose(seen, generator(1, 0, "shutter")).time)


def test_an_instant_exposure_is_sharp():
    seen = pixels()
    seen = type(seen)(seen.xy, seen.frame, seen.track, seen.open, seen.open, seen.value)
    assert Shutter(CAMERA, swaying(), 3).expose(seen).time.std(1).max() == 0


def test_no_pixels_give_no_rays():
    assert Shutter(CAMERA, swaying(), 3).expose(pixels(0)).shape == (0, 3)


def test_light_is_mixed_before_the_tone_curve():
    seen = pixels(1)
    shutter = Shutter(CAMERA, still(), 2, gamma)
    half_lit = wall(shutter.expose(seen))
    half_lit = type(half_lit)(
        torch.tensor([[[0.0] * 3, [1.0] * 3]]), half_lit.depth, half_lit.opacity, half_lit.weight
    )
    assert shutter.observe(half_lit, seen)[0, 0] == pytest.approx(0.5 ** (1 / 2.2))
