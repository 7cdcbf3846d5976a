"""Recipes on neural points: they learn, grow, resume, render, and have the published sizes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.protocols import Growing, Model
from sharpfield.fields.neural_points import PointSizes
from sharpfield.initialisation.point_cloud import CloudOptions, first_cameras, typical_spacing
from sharpfield.recipes.hybrid import BlurOptions, Hybrid
from sharpfield.recipes.point_nerf import PointNeRF
from sharpfield.recipes.points.images import SourceOptions, nearest_in_order
from sharpfield.recipes.points.model import PatchSamplingOptions, PointModel
from sharpfield.recipes.points.scene import GrowthOptions, MarchOptions
from sharpfield.rendering.view import render_view
from sharpfield.training.checkpoint import file_of
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import train
from tests.recipes.box import box
from tests.training.toy import quiet

STEPS = 20

SMALL: dict[str, Any] = dict(
    steps=STEPS,
    lr=2e-3,
    points_lr=5e-3,
    cloud=CloudOptions(max_points=1200, max_depth=float("inf"), colours="fused"),
    sizes=PointSizes(channels=4, width=16, feature=48, octaves=(1, 2, 2)),
    march=MarchOptions(voxel=0.0, steps=0, max_samples=8, thickness=1.0, background=0.0),
    growth=GrowthOptions(every=0.0),
)
PIXELS = PatchSamplingOptions(patches=96, patch_size=1, border=0, frames=2)
PATCHES = PatchSamplingOptions(patches=6, patch_size=4, spacing=(1, 2), border=0, frames=2)
HERE = SourceOptions(
    selection="pose",
    interpolation="bilinear",
    visibility="depth",
    quality_power=1.0,
    selection_quality_power=1.0,
)
EARLY = replace(SMALL["sizes"], average="early", axes="world", unit=0.0)

RECIPES: dict[str, Callable[[], Any]] = {
    "points": lambda: PointNeRF(sampling=PIXELS, **SMALL),
    "points, early": lambda: PointNeRF(
        sampling=PIXELS, **{**SMALL, "sizes": EARLY, "residual_colours": True}
    ),
    "H": lambda: Hybrid(
        sampling=PIXELS, blur=BlurOptions(kind="none"), frame_quality="even", **SMALL
    ),
    "Full": lambda: Hybrid(sampling=PATCHES, **SMALL),
    "learned": lambda: Hybrid(
        sampling=PATCHES, blur=BlurOptions(kind="learned", size=5), frame_quality="images", **SMALL
    ),
    "all ours": lambda: Hybrid(
        sampling=PATCHES,
        sources=HERE,
        blur=BlurOptions(light="linear"),
        frame_quality="auto",
        **{**SMALL, "sizes": EARLY, "residual_colours": True},
    ),
}


@pytest.mark.parametrize("name", RECIPES)
def test_twenty_steps_lower_the_loss_and_views_are_light(name: str):
    capture = box()
    model = RECIPES[name]().build(capture, 0)
    assert isinstance(model, Model)
    assert isinstance(model, Growing)
    before = held_out(model)
    optimizer = adam(model)
    fit(model, optimizer, steps=range(STEPS))
    assert held_out(model) < before
    seen = view(model, capture)
    assert seen.rgb.shape == (18, 24, 3)
    assert 0 <= float(seen.rgb.min()) <= float(seen.rgb.max()) <= 1


@pytest.mark.parametrize("name", ["points", "all ours"])
def test_a_view_does_not_depend_on_the_chunks(name: str):
    capture = box()
    model = RECIPES[name]().build(capture, 0)
    whole, parts = view(model, capture), view(model, capture, chunk=37)
    assert torch.allclose(whole.rgb, parts.rgb, atol=1e-5)


def test_resuming_equals_never_having_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    growth = GrowthOptions(every=0.2, until=1.0, frame_share=1.0, min_opacity=0.2, prune_below=0.2)
    recipe, stop_at = replace(RECIPES["all ours"](), growth=growth), 14

    def go(folder: str, *, resume: bool = False) -> bytes:
        options = TrainingOptions(checkpoint_every=5, resume=resume)
        train(
            lambda steps: recipe.build(box(), 1),
            tmp_path / folder,
            options,
            steps=STEPS,
            settings={},
            console=quiet(),
        )
        return file_of(tmp_path / folder, "last").read_bytes()

    straight = go("straight")
    draw = PointModel.draw

    def dying(model: PointModel, step: int) -> Any:
        if step == stop_at:
            raise KeyboardInterrupt
        return draw(model, step)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(PointModel, "draw", dying)
        go("stopped")
    assert go("stopped", resume=True) == straight


def test_points_grow_where_rays_miss_and_fall_out_where_they_are_unsure():
    capture = box()
    recipe = replace(
        RECIPES["points"](),
        growth=GrowthOptions(
            every=0.1, until=1.0, frame_share=1.0, min_opacity=0.1, prune_below=0.5
        ),
    )
    model = recipe.build(capture, 0)
    points = model.scene.field.points
    hole = (points.positions - torch.tensor([4.0, 1.5, 2.5])).norm(dim=-1) < 0.6
    kept = torch.nonzero(~hole)[:, 0]
    points.replace({name: rows[kept] for name, rows in points.points().items()})
    with torch.no_grad():
        points.confidence[:5] = 0.3
    before, unsure = len(points), points.positions[:5].clone()
    optimizer = adam(model)
    fit(model, optimizer, steps=range(4))
    after = model.scene.field.points
    assert len(after) > before - 5
    assert (torch.cdist(unsure, after.positions).amin(-1) > 1e-4).all()
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            state = optimizer.state.get(parameter, {})
            assert all(len(v) == len(parameter) for v in state.values() if v.ndim)


PUBLISHED = {
    "scene.field.reading": 138_752,
    "scene.field.seeing": 133_376,
    "scene.field.to_density": 257,
    "scene.field.to_feature": 68_992,
    "images.merging": 19_713,
    "images.extractor": 10_290,
    "images.mixing": 8_235,
    "head": 387,
}


def test_networks_have_the_published_numbers_of_parameters():
    recipe = Hybrid(
        cloud=CloudOptions(max_points=100),
        march=SMALL["march"],
        sampling=replace(PATCHES, patch_size=2),
    )
    model = recipe.build(box(), 0)
    sizes = {name: count(model.get_submodule(name)) for name in PUBLISHED}
    assert sizes == PUBLISHED
    assert sum(sizes.values()) == 380_002


def test_a_point_has_42_numbers():
    model = Hybrid(
        cloud=CloudOptions(max_points=100), sampling=PATCHES, march=SMALL["march"]
    ).build(box(), 0)
    points = model.scene.field.points
    assert sum(rows[0].numel() for rows in points.points().values()) == 42


def test_published_sources_are_four_neighbours_and_never_the_frame_itself():
    train = np.arange(0, 40, 5)
    table = nearest_in_order(40, train, 4)
    assert sorted(table[20]) == [10, 15, 25, 30]
    assert sorted(table[22]) == [15, 20, 25, 30]
    assert sorted(table[0]) == [5, 10, 15, 20]


def test_sources_by_pose_leave_the_own_frame_out_while_learning():
    capture = box()
    model = RECIPES["all ours"]().build(capture, 0)
    sources = model.images.sources
    frame = torch.as_tensor(capture.split.train)
    pose = sources.poses[frame]
    chosen = sources.of_rays(frame, pose[:, :, 3], pose[:, :, 2], exclude=True)
    assert not (chosen == frame[:, None]).any()
    told = sources.of_rays(frame, pose[:, :, 3], pose[:, :, 2], exclude=False)
    assert (told == frame[:, None]).any(-1).all()


def test_sources_see_what_their_pixels_show_and_nothing_behind_walls():
    capture = box()
    model = RECIPES["all ours"]().build(capture, 0)
    sources = model.images.sources
    frame = 3
    camera, at = capture.camera, sources.poses[frame]
    xy = camera.grid().reshape(-1, 2)
    ray = camera.direction(xy)
    depth = torch.from_numpy(capture.needed_depth.at(frame)).reshape(-1, 1)
    seen = ray / ray[:, 2:] * depth
    frames, source = torch.tensor([frame]), torch.zeros(len(xy), 1, dtype=torch.int64)
    for times, visible in ((1.0, 1.0), (3.0, 0.2)):
        places = (times * seen) @ at[:, :3].T + at[:, 3]
        shown = sources.project(places, places - at[:, 3], frames, source)
        assert torch.allclose(shown.xy[:, 0], xy, atol=1e-3)
        assert torch.allclose(shown.change, torch.zeros(()), atol=1e-5)
        inside = (xy > 0.01).all(-1)
        if visible == 1:
            assert torch.allclose(shown.visible[inside] / model.weight[frame], torch.ones(()))
        else:
            assert (shown.visible[inside] / model.weight[frame]).mean() < visible


def test_blur_on_single_pixels_is_refused_in_words():
    with pytest.raises(OptionError, match="blur needs patches, and single pixels are sampled"):
        Hybrid(sampling=PIXELS, **SMALL).build(box(), 0)


def test_spacing_is_that_of_a_regular_sheet():
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(60)), -1).reshape(-1, 2)
    sheet = np.concatenate([0.05 * grid, np.zeros((3600, 1))], 1).astype(np.float32)
    assert typical_spacing(sheet) == pytest.approx(0.05, rel=0.3)


def test_first_cameras_are_those_of_a_slow_loop():
    capture = box()
    random = np.random.default_rng(0)
    positions = random.uniform(-2, 2, (50, 3)).astype(np.float32)
    frames, directions = first_cameras(capture, torch.from_numpy(positions))
    train = capture.split.train
    poses = capture.frame_pose(train).double().numpy()
    for place, frame, direction in zip(positions, frames.tolist(), directions, strict=True):
        scores = []
        for pose in poses:
            way = place - pose[:, 3]
            away = np.linalg.norm(way)
            scores.append(away / 200 - way @ pose[:, 2] / away)
        chosen = train.tolist().index(frame)
        assert scores[chosen] == pytest.approx(min(scores), abs=1e-5)
        way = place - poses[chosen, :, 3]
        np.testing.assert_allclose(direction.numpy(), way / np.linalg.norm(way), atol=1e-5)


def held_out(model: PointModel) -> float:
    """Loss of the pixels of steps that come later."""
    with torch.no_grad():
        batches = [(step, model.draw(step)) for step in range(STEPS, STEPS + 3)]
        return sum(float(model.losses(batch, step)["frames"]) for step, batch in batches)


def view(model: PointModel, capture: Capture, **how: Any):
    frame = capture.split.test[1:2]
    pose = capture.frame_pose(frame)[0].float()
    time = float(capture.frame_time[frame[0]].mean())
    return render_view(model.render, capture.camera, pose, time, **how)


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
