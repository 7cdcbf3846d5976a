from dataclasses import replace

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture
from sharpfield.core.schedule import constant
from sharpfield.core.seed import generator
from sharpfield.geometry import se3
from sharpfield.geometry.rays import cast
from sharpfield.geometry.space import EvenDepth, Frustum, average_pose
from sharpfield.geometry.trajectory import Still
from sharpfield.recipes.volume.scene import Volume, VolumeOptions, stages

SMALL = VolumeOptions(
    voxels=(6**3, 12**3),
    channels=(4, 2, 2),
    coarse=(8, 3, 8),
    fine=(8, 5, 8),
    octaves=(2, 1),
    samples=(8, 6),
)
EVERY_KIND = pytest.mark.parametrize("kind", ["planes", "mlp", "voxels"])


def volume(capture: Capture, seed: int = 0, **change) -> Volume:
    return Volume(replace(SMALL, **change), capture, seed)


def rays(made: Volume, count: int = 10):
    """Of random pixels, half way through the capture."""
    xy = torch.rand(count, 2, generator=generator(0, 0, "pixels")) * 16
    half = torch.full((count,), 0.5)
    pose = made.path.pose(half, torch.zeros(count, dtype=torch.int64))
    return cast(made.capture.camera, pose, xy, half, half)


def ring(capture: Capture, count: int = 6) -> Capture:
    """The first frames from still cameras all around."""
    twist = np.zeros((count, 6))
    twist[:, 1] = np.linspace(0, 2 * np.pi, count, endpoint=False)
    turned = se3.exp(torch.from_numpy(twist)).numpy()
    turned[:, :, 3] = -3 * turned[:, :, 2]  # looking at the origin
    frames = replace(capture.needed_frames, track=np.arange(count, dtype=np.int64))
    return replace(capture, frames=frames, events=None, trajectory=Still(turned))


@EVERY_KIND
def test_the_seed_decides_how_it_starts(tiny: Capture, kind: str):
    first, same, other = (volume(tiny, seed, kind=kind).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], same[name]) for name in first)
    if kind != "voxels":  # a grid of voxels starts empty, whatever the seed
        assert not all(torch.equal(first[name], other[name]) for name in first)


def test_it_sees_the_capture_in_its_own_space(tiny: Capture):
    made = volume(tiny)
    assert made.capture.near == pytest.approx(4 / 3)
    every = np.arange(len(tiny.needed_frames))
    average = average_pose(made.capture.frame_pose(every).double().numpy())
    np.testing.assert_allclose(average, np.eye(3, 4), atol=1e-5)


def test_the_space_follows_the_cameras(tiny: Capture):
    assert isinstance(volume(tiny).space, Frustum)
    assert isinstance(volume(ring(tiny)).space, EvenDepth)
    assert isinstance(volume(tiny, space="metric").space, EvenDepth)
    assert isinstance(volume(ring(tiny), space="ndc").space, Frustum)


@EVERY_KIND
def test_light_depends_on_seed_step_and_stream(tiny: Capture, kind: str):
    made = volume(tiny, kind=kind)
    seen = rays(made)
    torch.nn.init.normal_(next(made.parameters()), generator=generator(0, 0, "grown"))
    first = made.sharp(seen, 3, "frames").depth
    assert torch.equal(made.sharp(seen, 3, "frames").depth, first)
    assert not torch.equal(made.sharp(seen, 4, "frames").depth, first)
    assert not torch.equal(made.sharp(seen, 3, "events").depth, first)
    assert torch.equal(made.view(seen).depth, made.view(seen).depth)


@pytest.mark.parametrize("kind", ["planes", "mlp"])
def test_features_have_the_width_they_say(tiny: Capture, kind: str):
    made = volume(tiny, kind=kind)
    found = made.sharp(rays(made), 0, "frames", samples=True)
    assert found.samples is not None
    assert found.samples.feature.shape == (10, 14, made.feature_width)


@EVERY_KIND
def test_stages(tiny: Capture, kind: str):
    made = volume(tiny, kind=kind)
    assert len(stages(made.sharp(rays(made), 0, "frames"))) == (1 if kind == "voxels" else 2)


@EVERY_KIND
def test_every_parameter_is_in_one_group(tiny: Capture, kind: str):
    made = volume(tiny, kind=kind)
    groups = made.groups(constant(1e-3), constant(1e-2))
    grouped = [id(p) for group in groups for p in group.parameters]
    assert sorted(grouped) == sorted(id(p) for p in made.parameters())
    wanted = {
        "planes": {"networks": 1e-3, "grids": 1e-2},
        "mlp": {"networks": 1e-3},
        "voxels": {"grids": 1e-2},
    }
    assert {group.name: group.rate(0) for group in groups} == wanted[kind]


def test_what_does_not_vary_is_smooth(tiny: Capture):
    made = volume(tiny)
    assert made.smoothness() > 0
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.fill_(0.3)
    assert made.smoothness() == 0
    assert volume(tiny, kind="mlp").smoothness() == 0


def test_floaters_are_cleared_in_evaluation_only(tiny: Capture):
    made, cleared = volume(tiny), volume(tiny, clear_before=0.9)
    seen = rays(made)
    assert torch.equal(made.sharp(seen, 0, "a").rgb, cleared.sharp(seen, 0, "a").rgb)
    assert (cleared.view(seen).depth >= 0.9).all()
    assert (made.view(seen).depth < 0.9).any()


def test_half_precision_is_close(tiny: Capture):
    exact, rough = volume(tiny), volume(tiny, precision="bfloat16")
    seen = rays(exact)
    torch.testing.assert_close(rough.view(seen).rgb, exact.view(seen).rgb, rtol=0, atol=0.05)
    assert rough.view(seen).rgb.dtype == torch.float32
