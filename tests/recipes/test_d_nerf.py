"""D-NeRF: frames of a moving scene through a canonical one."""

import torch

from sharpfield.recipes.d_nerf import DNeRF
from sharpfield.recipes.volume.moving_scenes import WarpedOptions
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from tests.recipes.moving import tiny_moving

SMALL = DNeRF(
    steps=30,
    lr=5e-3,
    lr_decay_steps=100,
    pixels=64,
    instants=3,
    scene=WarpedOptions(
        width=16,
        depth=6,
        samples=(8, 8),
        colours=3,
        networks=2,
        density="softplus",
        opaque_end=False,
        shared_jitter=True,
    ),
)


def test_thirty_steps_lower_the_error_of_both_stages():
    model = SMALL.build(tiny_moving(), 0)
    batch = model.draw(50)
    before = {name: float(term.detach()) for name, term in model.losses(batch, 50).items()}
    fit(model, adam(model), steps=range(30))
    after = model.losses(batch, 50)
    assert set(before) == {"coarse", "fine"}
    assert all(float(after[name].detach()) < before[name] for name in before)


def test_blurred_frames_are_explained_by_several_instants_sharp_ones_by_one():
    assert SMALL.build(tiny_moving(30_000), 0).shutter.samples == 3
    assert SMALL.build(tiny_moving(), 0).shutter.samples == 1


def test_events_are_not_needed():
    model = SMALL.build(tiny_moving().without(events=True), 0)
    light = model.render(model.shutter.expose(model.draw(0)["frames"]))
    assert light.rgb.shape == (64, 1, 3)
    stored = model.encode(light.rgb)
    assert bool(((stored >= 0) & (stored <= 1)).all())
    assert torch.isfinite(stored).all()
