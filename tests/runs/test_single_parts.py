"""Single parts used alone, by the names that the rooms offer."""

import numpy as np
import pytest
import torch

import sharpfield as sf

ROOMS = ("core", "ops", "events", "losses", "metrics", "geometry", "simulation")


@pytest.mark.parametrize("room", ROOMS)
def test_every_name_of_a_room_exists(room: str) -> None:
    offered = dir(getattr(sf, room))
    assert offered
    for name in offered:
        assert getattr(getattr(sf, room), name) is not None


def scene(count: int = 1) -> list:
    """Round grey Gaussians in front of a camera at the origin."""
    along = torch.arange(count) + 2.0
    means = torch.stack([torch.zeros(count), torch.zeros(count), along], -1)
    turned = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    canvas = sf.ops.Canvas(sf.Camera(8, 6, 8.0, 8.0, 4.0, 3.0), torch.zeros(1, 2).long(), (8, 6))
    grey, pose = torch.full((1, count, 3), 0.5), torch.eye(3, 4)[None]
    return [
        means,
        turned,
        torch.full((count, 3), 0.4),
        torch.full((count,), 0.9),
        grey,
        pose,
        canvas,
    ]


def test_gaussians_are_drawn_by_a_function() -> None:
    drawn = sf.ops.rasterize(*scene())
    assert drawn.light.shape == (1, 6, 8, 3)
    assert drawn.opacity[0, 3, 4] > 0.5 > drawn.opacity[0, 0, 0]


@pytest.mark.parametrize(
    ("place", "wrong", "said"),
    [
        (0, torch.zeros(3), r"(?s)`means` of rasterize.*shape \(3,\).*Float\[Tensor, 'n 3'\]"),
        (2, torch.zeros(2, 3), r"(?s)`scales`.*shape \(2, 3\).*axes of one name agree"),
        (3, torch.zeros(1).long(), r"(?s)`opacities`.*int64"),
        (5, "here", r"(?s)`poses`.*got    str"),
    ],
)
def test_wrong_shapes_are_said(place: int, wrong: object, said: str) -> None:
    arguments = scene()
    arguments[place] = wrong
    with pytest.raises(sf.core.ShapeError, match=said):
        sf.ops.rasterize(*arguments)


def test_other_arguments_are_said() -> None:
    with pytest.raises(sf.core.OptionError, match="call mse"):
        sf.losses.mse()
    assert float(sf.losses.mse(torch.zeros(2, 3), torch.ones(2, 3))) == 1
    assert float(sf.metrics.psnr(torch.zeros(2, 3, 3), torch.ones(2, 3, 3))) == 0


def test_images_make_events() -> None:
    """Light that doubles crosses a threshold of 0.2 three times: log 2 = 0.69."""
    images = np.ones((2, 4, 5), np.float32)
    images[1, 2, 3] = 2
    events = sf.simulation.events(images, [0, 1000], sensor=sf.simulation.EventSensor(floor=0.0))
    assert (events.width, events.height) == (5, 4) and len(events) == 3
    assert set(events.x) == {3} and set(events.y) == {2} and (events.p == 1).all()
    assert np.allclose(events.t_us, 1000 * np.array([0.2, 0.4, 0.6]) / np.log(2), atol=1)
    with pytest.raises(sf.SharpfieldError, match="one time for each image"):
        sf.simulation.events(images, [0])


def test_a_blurred_image_becomes_sharp() -> None:
    """One pixel brightens by one threshold in the middle of the exposure."""
    x, y, p = np.array([1], np.int16), np.array([0], np.int16), np.array([1], np.int8)
    events = sf.EventStream(x, y, np.array([500]), p, width=2, height=1)
    before, after = 0.2, 0.2 * np.exp(0.3)
    blurred = torch.full((1, 2, 1), 0.2)
    blurred[0, 1] = (before + after) / 2
    sharp = sf.events.edi(blurred, events, (0, 1000), instants_us=[100, 900], threshold=0.3)
    assert sharp.shape == (2, 1, 2, 1)
    assert sharp[:, 0, 0].flatten().tolist() == pytest.approx([0.2, 0.2])
    assert sharp[:, 0, 1].flatten().tolist() == pytest.approx([before, after], rel=1e-5)
    with pytest.raises(sf.core.ShapeError, match="other sizes"):
        sf.events.edi(blurred[:, :1], events, (0, 1000))
    with pytest.raises(sf.core.OptionError, match="within the exposure"):
        sf.events.edi(blurred, events, (0, 1000), instants_us=[2000])
