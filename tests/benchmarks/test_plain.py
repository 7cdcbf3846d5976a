"""The plain formulation is a fair opponent only if it computes the same."""

import pytest
import torch
from torch import Tensor

from benchmarks.plain import Plain
from benchmarks.plain_field import PlainHead, PlainVolume
from sharpfield.core.seed import generator
from sharpfield.fields.plane_grid import PlaneHead, Volume
from sharpfield.geometry.rays import cast
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF, Model
from sharpfield.recipes.volume.scene import VolumeOptions
from sharpfield.recipes.volume.terms import EventOptions, FrameOptions
from sharpfield.simulation.static_capture import Rig, Timing, simulate

KERNEL = 1199
"""The first step with everything switched on."""


@pytest.fixture(scope="module")
def model() -> Model:
    """A tiny one, moved off its start so that images, motions and rays differ."""
    timing = Timing(frames=4, exposure_us=20_000, interval_us=25_000, step_us=2000)
    capture = simulate(rig=Rig((16, 12)), timing=timing)
    recipe = EvDeblurNeRF(
        volume=VolumeOptions(voxels=(12**3, 20**3), samples=(16, 16)),
        frames=FrameOptions(pixels=6, blurred_pixels=6),
        events=EventOptions(pairs=20),
    )
    made, random = recipe.build(capture, seed=0), generator(0, 0, "moved")
    with torch.no_grad():
        for name, parameter in made.named_parameters():
            if not name.startswith("volume"):
                parameter += 0.05 * torch.randn(parameter.shape, generator=random)
    return made


@pytest.mark.parametrize("step", [KERNEL, 15_000])
def test_the_losses_are_ours(model: Model, step: int):
    ours = model.losses(model.draw(step), step)
    plain = Plain(model)
    theirs = plain.losses(plain.draw(step), step)
    assert ours.keys() == theirs.keys() == {"blur", "adaptive", "prior", "events", "smooth"}
    for name, loss in ours.items():
        assert loss > 0
        torch.testing.assert_close(theirs[name], loss, rtol=2e-4, atol=1e-8, msg=name)


def laid_out(volume: Volume, head: PlaneHead) -> dict[str, list[Tensor]]:
    """Our gradients in the plain layout."""
    assert all(parameter.grad is not None for parameter in volume.parameters())
    return {
        "planes": [plane.grad.permute(2, 0, 1)[None] for plane in volume.planes],
        "lines": [line.grad.T[None, ..., None] for line in volume.lines],
        "basis": [volume.basis.weight.grad],
        "density": [head.inside.weight.grad, head.out.weight.grad],
        "colour": [
            torch.cat([head.first.of_sample.grad, head.first.of_ray.grad], 1),
            *[part.weight.grad for part in head.last.layers],
        ],
    }


def plain_ones(volume: PlainVolume, head: PlainHead) -> dict[str, list[Tensor]]:
    return {
        "planes": [plane.grad for plane in volume.planes],
        "lines": [line.grad for line in volume.lines],
        "basis": [volume.basis.weight.grad],
        "density": [part.weight.grad for part in head.density],
        "colour": [part.weight.grad for part in head.colour],
    }


def test_the_gradients_are_ours(model: Model):
    losses = model.losses(model.draw(KERNEL), KERNEL)
    torch.stack(list(losses.values())).sum().backward()
    field = model.volume.field
    ours = [
        laid_out(volume, head)
        for volume, head in zip(field.volumes, (field.coarse, field.fine), strict=True)
    ]
    shared = {n: p.grad for n, p in model.named_parameters() if not n.startswith("volume")}
    model.zero_grad(set_to_none=True)

    plain = Plain(model)
    losses = plain.losses(plain.draw(KERNEL), KERNEL)
    torch.stack(list(losses.values())).sum().backward()
    close = plain.field
    theirs = [
        plain_ones(close.coarse_volume, close.coarse),
        plain_ones(close.fine_volume, close.fine),
    ]
    for stage, wanted in enumerate(ours):
        for name, values in wanted.items():
            for mine, other in zip(values, theirs[stage][name], strict=True):
                assert_near(other, mine, mine.abs().max(), f"{stage} {name}")
    again = {n: p.grad for n, p in model.named_parameters() if not n.startswith("volume")}
    model.zero_grad(set_to_none=True)
    reached = {name: wanted for name, wanted in shared.items() if wanted is not None}
    assert len(reached) > 20 and reached.keys() == {n for n, g in again.items() if g is not None}
    for name, wanted in reached.items():
        network = [g for n, g in reached.items() if n.split(".")[:3] == name.split(".")[:3]]
        largest = torch.stack([g.abs().max() for g in network]).max()
        # Softmax and normalisation cancel some of them to nothing but rounding.
        scale = wanted.abs().max().maximum(1e-2 * largest)
        assert_near(again[name], wanted, scale, name)


def assert_near(found: Tensor, wanted: Tensor, scale: Tensor, name: str) -> None:
    """To half a percent of the scale: sums run in another order."""
    off = (found - wanted).abs().max() / scale
    assert off < 5e-3, f"{name}: {off:.1e}"


def test_a_view_is_ours(model: Model):
    camera, path = model.capture.camera, model.capture.trajectory
    half = torch.tensor(0.5)
    pose = path.pose(half, torch.tensor(0))
    xy = camera.grid().reshape(-1, 2)
    ones = torch.ones(len(xy))
    rays = cast(camera, pose.expand(len(xy), 3, 4), xy, 0.5 * ones, ones)
    with torch.no_grad():
        ours, theirs = model.render(rays), Plain(model).render(rays)
    torch.testing.assert_close(theirs.rgb, ours.rgb, atol=2e-3, rtol=0)
    torch.testing.assert_close(theirs.depth, ours.depth, atol=2e-3, rtol=0)
