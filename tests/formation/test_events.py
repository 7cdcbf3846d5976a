import pytest
import torch

from sharpfield.core.protocols import Formation
from sharpfield.core.tone import gamma
from sharpfield.formation.events import ChainedContrast, LogContrast
from sharpfield.formation.mixing import mix
from sharpfield.formation.response import FixedResponse, LearnedResponse
from tests.formation.toy import CAMERA, chains, lit, pairs, swaying, wall


def sensor(**options) -> LogContrast:
    return LogContrast(CAMERA, swaying(), FixedResponse(**options))


def test_it_is_a_formation():
    assert isinstance(sensor(), Formation)


def test_a_pair_is_seen_through_the_same_pixel_at_both_times():
    seen = pairs()
    rays = sensor().expose(seen)
    assert torch.equal(rays.time, torch.stack([seen.start, seen.end], 1))
    assert torch.equal(rays.weight, torch.tensor([[-1.0, 1.0]]).expand(7, 2))
    for b in range(7):
        for k, time in enumerate((seen.start[b], seen.end[b])):
            pose = swaying().pose(time[None], seen.track[:1])[0]
            torch.testing.assert_close(rays.origin[b, k], pose[:, 3])
            direction = pose[:, :3] @ CAMERA.direction(seen.xy[b])
            torch.testing.assert_close(rays.direction[b, k], direction)


def test_a_mono_pixel_reports_the_change_of_log_luma():
    seen = pairs()
    light = wall(sensor(curve=gamma).expose(seen))
    observed = sensor(curve=gamma).observe(light, seen)
    red, green, blue = gamma(light.rgb).unbind(-1)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    expected = (luma[:, 1] + 1e-5).log() - (luma[:, 0] + 1e-5).log()
    torch.testing.assert_close(observed, expected[:, None])


def test_a_bayer_pixel_reports_its_own_colour_alone():
    seen = pairs(bayer=True)
    rgb = (0.1 + torch.rand(7, 2, 3)).requires_grad_()
    observed = sensor().observe(lit(rgb, torch.tensor([[-1.0, 1.0]]).expand(7, 2)), seen)
    observed.sum().backward()
    assert seen.channel is not None and rgb.grad is not None
    for b, own in enumerate(seen.channel.tolist()):
        expected = ((rgb[b, 1, own] + 1e-5) / (rgb[b, 0, own] + 1e-5)).log()
        torch.testing.assert_close(observed[b, 0], expected)
        others = [c for c in range(3) if c != own]
        assert rgb.grad[b][:, own].abs().min() > 0
        assert rgb.grad[b][:, others].abs().max() == 0


def test_a_grey_scene_on_a_bayer_sensor():
    grey = lit(torch.tensor([[[0.2], [0.4]]]), torch.tensor([[-1.0, 1.0]]))
    assert sensor().observe(grey, pairs(1, bayer=True)).item() == pytest.approx(0.69312, abs=1e-5)


def test_the_published_example():
    light = torch.tensor([0.2, 0.25], dtype=torch.float64)[None, :, None].expand(1, 2, 3)
    weight = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
    change = sensor().observe(lit(light, weight), pairs(1)).item()
    assert change == pytest.approx(0.223134, abs=5e-7)
    assert (change - 0.2) ** 2 == pytest.approx(5.35e-4, abs=5e-7)


def test_black_and_equal_times_stay_finite():
    seen = pairs()
    dark = torch.zeros(7, 2, 3, requires_grad=True)
    change = sensor(curve=gamma).observe(lit(dark, torch.ones(7, 2)), seen)
    change.sum().backward()
    assert change.isfinite().all() and dark.grad is not None and dark.grad.isfinite().all()


def test_no_pairs():
    rays = sensor().expose(pairs(0))
    assert rays.shape == (0, 2) and sensor().observe(wall(rays), pairs(0)).shape == (0, 1)


@pytest.mark.parametrize("bayer", [False, True])
def test_a_chain_is_its_pairs(bayer):
    """Also where the response reads each pair's own counts."""
    seen = chains(bayer=bayer)
    response = LearnedResponse(polarity_start="random", steps=20)
    one_by_one = LogContrast(CAMERA, swaying(), response)
    chained, flat = ChainedContrast(one_by_one), seen.reshape(-1)
    rays = chained.expose(seen)
    assert rays.shape == (5, 5)
    torch.testing.assert_close(
        chained.observe(wall(rays), seen), one_by_one.observe(wall(one_by_one.expose(flat)), flat)
    )


def test_the_weights_of_a_chain_give_its_whole_change():
    seen, chained = chains(), ChainedContrast(sensor())
    light = wall(chained.expose(seen))
    whole = mix(light, inner=lambda rgb: sensor().response(rgb, seen[:, 0]))
    torch.testing.assert_close(chained.observe(light, seen).view(5, 4).sum(1, keepdim=True), whole)


def test_a_chain_of_one_is_a_pair():
    seen = chains(length=1)
    rays, flat = ChainedContrast(sensor()).expose(seen), sensor().expose(seen[:, 0])
    for name in ("origin", "direction", "time", "weight"):
        torch.testing.assert_close(getattr(rays, name), getattr(flat, name))
