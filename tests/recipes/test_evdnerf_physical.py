"""EvDNeRF made physical: what stands still makes no event, hulls, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.fields.voxels import VoxelSizes
from sharpfield.geometry.normalise import recentred
from sharpfield.initialisation.visual_hull import carve_visual_hull, silhouettes
from sharpfield.recipes.evdnerf_physical import EvDNeRFPhysical, WindowOptions
from sharpfield.recipes.volume.moving_scenes import MovingOptions
from sharpfield.simulation.cameras.rigs import hand_held, ring
from sharpfield.simulation.moving_capture import MOVING_RIG, MOVING_TIMING, simulate_moving
from sharpfield.storage.event_cache import event_index
from sharpfield.training.optim import adam
from tests.recipes.moving import tiny_moving

SMALL = EvDNeRFPhysical(
    steps=40,
    lr_decay_steps=40,
    pixels=32,
    frame_weight=20.0,
    scene=MovingOptions(
        size=VoxelSizes(static=12, moving=8, moments=4), samples=16, density_weight=0.1
    ),
    windows=WindowOptions(exact=32, counted=32),
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
def test_steps_lower_every_term(exposure_us: int):
    capture = tiny_moving(exposure_us)
    start = SMALL.build(capture, 0)
    batch = start.draw(90)
    before = start.losses(batch, 90)
    after = learned(SMALL, capture, 60).losses(batch, 90)
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
        model.scene.field.static[0][..., 0] = -40
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


def test_voxels_move_only_within_the_hull():
    capture = tiny_moving().without(frames=True)
    start = SMALL.build(capture, 0).scene.field
    model = learned(SMALL, capture, 8)
    size = SMALL.scene.size
    told = carve_visual_hull(
        model.capture, event_index(capture.needed_events), cells=size.moving, moments=size.moments
    )
    assert told is not None and told.solid.any()
    (values, held), (first, _) = (
        one.moments(0, size.moments) for one in (model.scene.field, start)
    )
    assert torch.equal(held, told.possible) and held.any() and not held.all()
    assert not values[~held].any() and values[held].any()
    assert (first[..., 0][told.solid] == SMALL.scene.moving_density).all()
    assert not first[..., 0][~told.solid].any()


@pytest.fixture(scope="module")
def puppet():
    """32x32 pixels, four cameras to learn from, one held out."""
    timing = replace(MOVING_TIMING, frames=9, interval_us=125_000, step_us=12_500)
    rig = replace(MOVING_RIG, size=(32, 32))
    return recentred(simulate_moving("puppet", ring(4, held_out=1), rig=rig, timing=timing))


def test_the_hull_holds_what_moves(puppet):
    """By the true depth of what a held-out camera sees."""
    capture, _ = puppet
    told = carve_visual_hull(capture, event_index(capture.needed_events), cells=24, moments=17)
    assert told is not None and told.possible.float().mean() < 0.3
    frames, camera, covered = capture.needed_frames, capture.camera, []
    toward = camera.direction(camera.grid()).float()
    for i in capture.split.test:
        depth = torch.from_numpy(frames.depth[i])
        local = toward / toward[..., 2:] * depth[..., None]
        pose = capture.frame_pose(np.array([i]))[0].float()
        place = (local[depth.isfinite()] @ pose[:, :3].T + pose[:, 3] + 1) / 2 * 23
        x, y, z = place.round().long().clamp(0, 23).unbind(-1)
        moment = round(16 * float(capture.clock.unit(frames.exposure.middle_us)[i]))
        covered.append(told.possible[moment, z, y, x].float().mean())
    assert float(torch.stack(covered).mean()) > 0.9


def test_silhouettes_are_those_of_the_truth(puppet):
    capture, _ = puppet
    frames, seen = capture.needed_frames, silhouettes(capture, event_index(capture.events), 0, 33)
    own = np.flatnonzero(frames.track == 0)
    at = np.rint(32 * capture.clock.unit(frames.exposure.middle_us[own])).astype(int)
    truth = torch.from_numpy(np.isfinite(frames.depth[own]))
    same = (seen[at] & truth).sum((1, 2)) / (seen[at] | truth).sum((1, 2))
    assert float(same.mean()) > 0.5


def test_no_hull_without_cameras_that_stand_still():
    timing = replace(MOVING_TIMING, frames=3)
    carried = simulate_moving(
        "glider", hand_held(), rig=replace(MOVING_RIG, size=(12, 12)), timing=timing
    )
    capture, _ = recentred(carried)
    assert (
        carve_visual_hull(capture, event_index(capture.needed_events), cells=6, moments=3) is None
    )
    field = SMALL.build(carried, 0).scene.field
    assert all((rows >= 0).all() for rows in field.rows)


def test_thresholds_are_learned_only_if_asked():
    capture = tiny_moving()
    names = {group.name for group in SMALL.build(capture, 0).groups()}
    windows = replace(SMALL.windows, learn_threshold=True)
    more = {g.name for g in replace(SMALL, windows=windows).build(capture, 0).groups()}
    assert more - names == {"thresholds"}


def test_clocks_of_cameras_are_learned_only_if_asked():
    capture = tiny_moving().without(frames=True)
    seen = SMALL.build(capture, 0).draw(0)["windows"]
    assert SMALL.build(capture, 0).without_offset(seen) is seen
    windows = replace(SMALL.windows, learn_offset=True)
    model = learned(replace(SMALL, windows=windows), capture, 4)
    assert model.offset is not None and model.offset.abs().max() > 0, "a loss depends on it"
    with torch.no_grad():
        model.offset.copy_(torch.tensor([0.1, 0.3, 0.2]))
    shift = torch.tensor([0.1, -0.1, 0.0])[seen.track]
    true = model.without_offset(seen)
    torch.testing.assert_close(true.start, seen.start + shift)
    torch.testing.assert_close(true.end, seen.end + shift)
