"""Whole views of an exposure and of event windows: which to render, what is measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sharpfield.core.capture import Clock
from sharpfield.core.measurements import EventPairs, Instants, Pixels
from sharpfield.core.rays import Radiance
from sharpfield.core.tone import tone_of
from sharpfield.formation.exposure import EventWindow, ExposureOfViews
from sharpfield.formation.response import FixedResponse
from sharpfield.geometry.rolling import Rolling
from sharpfield.geometry.trajectory import Stamped

M, H, W = 2, 5, 4
TONE = tone_of("gamma2.2")


def rolling(readout: float = 0.0) -> Rolling:
    """A camera that moves along x by one world unit over the capture."""
    poses = np.repeat(np.eye(4)[None, :3], 2, 0)
    poses[1, 0, 3] = 1
    path = Stamped(np.array([0, 1000]), poses, Clock(0, 1000), translation="linear")
    return Rolling(path, readout)


def instants(count: int) -> Instants:
    time = torch.linspace(0.2, 0.6, count).expand(M, count)
    zeros = torch.zeros(M, count, dtype=torch.int64)
    corner = torch.tensor([1, 2]).expand(M, count, 2)
    return Instants(time, zeros, torch.full((M, count), 1 / count), corner, (W, H))


def light(count: int, channels: int = 3, seed: int = 0, weight: float | None = None) -> Radiance:
    made = torch.Generator().manual_seed(seed)
    rgb = torch.rand(M, H, W, count, channels, generator=made) + 0.1
    one = torch.ones(M, H, W, count)
    return Radiance(rgb, one, one, one * (1 / count if weight is None else weight))


def pixels(*shape: int) -> Pixels:
    frame = torch.arange(M).view(-1, *[1] * (len(shape) - 1)).expand(shape)
    zeros = torch.zeros(shape)
    return Pixels(zeros[..., None].expand(*shape, 2), frame, frame, zeros, zeros, zeros[..., None])


def windows(count: int, colours: int = 1) -> EventPairs:
    shape = (M, count, H, W, colours)
    zeros = torch.zeros(shape)
    channel = torch.arange(3).expand(shape) if colours == 3 else None
    xy = zeros[..., None].expand(*shape, 2)
    return EventPairs(xy, zeros.long(), zeros, zeros, zeros, zeros, channel)


def test_views_are_where_the_camera_was_and_of_the_same_crop():
    seen = instants(3)
    views = ExposureOfViews(rolling(), TONE.encode).expose(seen)
    torch.testing.assert_close(views.pose[..., 0, 3], seen.time)
    assert views.rows is None and views.size == seen.size
    for name in ("time", "weight", "corner"):
        assert torch.equal(getattr(views, name), getattr(seen, name))


def test_with_a_rolling_shutter_views_are_of_the_middle_row_and_carry_all():
    seen = instants(2)
    views = ExposureOfViews(rolling(0.2), TONE.encode).expose(seen)
    torch.testing.assert_close(views.time, seen.time)
    torch.testing.assert_close(views.pose[..., 0, 3], seen.time + 0.1)
    assert views.rows is not None
    torch.testing.assert_close(views.rows[:, :, 0, 0, 3], seen.time)
    torch.testing.assert_close(views.rows[:, :, -1, 0, 3], seen.time + 0.2)


def test_views_of_events_are_at_the_corrected_time():
    seen = instants(2)
    views = EventWindow(rolling(), FixedResponse()).expose(seen, seen.time - 0.05)
    torch.testing.assert_close(views.pose[..., 0, 3], seen.time - 0.05)


def test_a_blurred_frame_is_the_stored_mean_light():
    few, more = light(2), light(4, seed=1, weight=1 / 6)
    exposure = ExposureOfViews(rolling(), TONE.encode)
    seen = pixels(M, H, W)
    torch.testing.assert_close(exposure.observe(few, seen), TONE.encode(few.rgb.mean(-2)))
    whole = torch.cat([few.rgb, more.rgb], -2).mean(-2)
    torch.testing.assert_close(exposure.observe(few, seen, more), TONE.encode(whole))


def test_gains_make_each_frame_brighter_before_it_is_stored():
    gain = torch.tensor([0.0, 0.3], requires_grad=True)
    plain, bright = (ExposureOfViews(rolling(), TONE.encode, g) for g in (None, gain))
    for observe, seen in (("observe", pixels(M, H, W)), ("observe_each", pixels(M, H, W, 3))):
        one, other = (getattr(made, observe)(light(3), seen) for made in (plain, bright))
        torch.testing.assert_close(one[0], other[0])
        linear = TONE.decode(one[1]) * np.exp(0.3)
        torch.testing.assert_close(TONE.decode(other[1]), linear, rtol=1e-4, atol=1e-5)
        assert torch.autograd.grad(other.sum(), gain)[0].all()


def test_a_still_view_is_its_own_mean():
    """No motion, no blur: the law of every frame sensor."""
    still = light(1)
    three = replace(
        still,
        **{name: getattr(still, name).repeat_interleave(3, 3) for name in ("rgb", "depth")},
        opacity=torch.ones(M, H, W, 3),
        weight=torch.full((M, H, W, 3), 1 / 3),
    )
    exposure, seen = ExposureOfViews(rolling(), TONE.encode), pixels(M, H, W)
    torch.testing.assert_close(exposure.observe(three, seen), exposure.observe(still, seen))
    change = EventWindow(rolling(), FixedResponse()).observe(three, windows(2))
    assert not change.any(), "constant light, no events"


def test_changes_are_differences_of_log_luma_pixel_by_pixel():
    seen = light(4)
    found = EventWindow(rolling(), FixedResponse(floor=0.0)).observe(seen, windows(3))
    luma = (seen.rgb * torch.tensor([0.299, 0.587, 0.114])).sum(-1)
    for m in range(M):
        for q in range(3):
            wanted = (luma[m, :, :, q + 1] / luma[m, :, :, q]).log()
            torch.testing.assert_close(found[m, q, :, :, 0], wanted)


def test_behind_a_filter_they_are_those_of_each_colour():
    seen = light(4)
    found = EventWindow(rolling(), FixedResponse(floor=0.0)).observe(seen, windows(3, 3))
    log = seen.rgb.log()
    wanted = (log[:, :, :, 1:] - log[:, :, :, :-1]).movedim(3, 1)
    torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize("observe", ["frame", "events"])
def test_gradients(observe: str):
    made = light(2, channels=1)

    def observed(rgb: Tensor) -> Tensor:
        seen = Radiance(rgb, *(getattr(made, n).double() for n in ("depth", "opacity", "weight")))
        if observe == "frame":
            return ExposureOfViews(rolling(), TONE.encode).observe(seen, pixels(M, H, W))
        return EventWindow(rolling(), FixedResponse()).observe(seen, windows(1))

    assert torch.autograd.gradcheck(observed, made.rgb.double().requires_grad_())
