"""EvDNeRF made physical: what stands still makes no event, hulls, and that it learns."""

from dataclasses import replace

import pytest
import torch

from sharpfield.captures import event_index
from sharpfield.fields.space_time import SpaceTimeSize
from sharpfield.geometry.centred import centred
from sharpfield.recipes.evdnerf_physical import EvDNeRFPhysical, WindowOptions
from sharpfield.recipes.moving import MovingOptions
from sharpfield.recipes.swept import swept
from sharpfield.training.optim import adam
from tests.recipes.moving import tiny_moving

SMALL = EvDNeRFPhysical(
    steps=40,
    decay=40,
    pixels=32,
    frames=20.0,
    scene=MovingOptions(size=SpaceTimeSize(still=12, moving=8, moments=4), steps=16, empty=0.1),
    windows=WindowOptions(spans=32, counted=32),
)


def learned(recipe: EvDNeRFPhysical, capture, steps: int = 20):
    model = recipe.build(capture, 0)
    optimizer = adam(model)
    for step in range(steps):
        optimizer.zero_grad()
        sum(model.losses(model.draw(step), step).values()).backward()
        optimizer.step()
    return model


@pytest.mark.parametrize("exposure_us", [0, 30_000])
def test_twenty_steps_lower_every_term(exposure_us: int):
    capture = tiny_moving(exposure_us)
    start, batch = SMALL.build(capture, 0), None
    batch = start.draw(30)
    before = start.losses(batch, 30)
    after = learned(SMALL, capture).losses(batch, 30)
    for name in ("spans", "windows", "frames"):
        assert float(after[name]) < float(before[name]), name
    assert start.shutter.samples == (1 if exposure_us == 0 else SMALL.instants)


def test_what_stands_still_makes_no_event_at_all():
    """Both instants are seen at the same points, jittered or not."""
    model = learned(SMALL, tiny_moving().without(frames=True))
    with torch.no_grad():
        for grid in model.scene.field.moving:
            grid.zero_()
    seen = model.draw(3)["windows"]
    light = model.scene.sharp(model.sensor.expose(seen), 3, "events")
    assert model.sensor.observe(light, seen).abs().max() == 0


def test_empty_space_shows_the_background():
    model = SMALL.build(tiny_moving().without(frames=True), 0)
    with torch.no_grad():
        model.scene.field.still[0][..., 0] = -40
        model.scene.field.behind.copy_(torch.tensor([0.0, 1.0, -1.0]))
    rays = model.sensor.expose(model.draw(0)["windows"])
    expected = torch.sigmoid(model.scene.field.behind).expand(*rays.shape, 3)
    torch.testing.assert_close(model.render(rays).rgb, expected, atol=1e-5, rtol=0)


def test_changes_of_windows_add_up_and_flip():
    model = learned(SMALL, tiny_moving().without(frames=True))
    seen = model.draw(0)["windows"]
    middle = (seen.start + seen.end) / 2

    def change(start, end):
        part = replace(seen, start=start, end=end)
        return model.sensor.observe(model.render(model.sensor.expose(part)), part)

    whole = change(seen.start, seen.end)
    parts = change(seen.start, middle) + change(middle, seen.end)
    torch.testing.assert_close(parts, whole, atol=1e-5, rtol=0)
    torch.testing.assert_close(change(seen.end, seen.start), -whole, atol=1e-6, rtol=0)


def test_voxels_outside_the_hull_never_move():
    capture = tiny_moving().without(frames=True)
    model = learned(SMALL, capture, 8)
    index = event_index(capture.needed_events)
    grid = model.scene.field.moving[0].detach()
    outside = ~swept(model.capture, index, grid.shape[1])
    assert outside.any() and not outside.all()
    assert not grid[:, outside].any()
    assert grid[:, ~outside].any()


def test_the_hull_holds_what_moves():
    """All moving parts of the scene stay within 1.2 of the middle of the table."""
    capture, change = centred(tiny_moving())
    hull = swept(capture, event_index(capture.needed_events), 9)
    assert hull[4, 4, 4], "the hub is at the origin"
    assert change.scale == pytest.approx(1 / 1.44, rel=0.01)


def test_thresholds_are_learned_only_if_asked():
    capture = tiny_moving()
    names = {group.name for group in SMALL.build(capture, 0).groups()}
    windows = replace(SMALL.windows, learn_threshold=True)
    more = {g.name for g in replace(SMALL, windows=windows).build(capture, 0).groups()}
    assert more - names == {"thresholds"}
