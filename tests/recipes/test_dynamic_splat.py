"""Moving Gaussians: they learn from whatever there is, start where things move, resume alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sharpfield.captures.native.layout import write
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.protocols import Growing, Model
from sharpfield.core.rays import Rays, Views
from sharpfield.evaluation.event_scores import HasLogLight
from sharpfield.geometry.normalise import recentred
from sharpfield.initialisation.static_scene import backdrop
from sharpfield.initialisation.visual_hull import box_cells, moving_cells
from sharpfield.recipes.splat import DynamicSplat, EvDynamicSplat
from sharpfield.recipes.splats.learned_calibration import LearnedCalibrationOptions
from sharpfield.recipes.splats.model import SplatModel
from sharpfield.rendering.splat import whole
from sharpfield.rendering.view import ViewRenderer, render_view
from sharpfield.runs.run import open_run
from sharpfield.storage.event_cache import event_index
from sharpfield.storage.ply import read_splats
from sharpfield.training.checkpoint import file_of
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import train
from tests.cli.command import run
from tests.recipes.moving import tiny_moving
from tests.training.toy import quiet

STEPS = 40


def small(recipe: type[DynamicSplat] = EvDynamicSplat, **changes: Any) -> DynamicSplat:
    """A recipe at a size for tests."""
    made = replace(recipe(), steps=STEPS, **changes)
    return replace(made, gaussians=replace(made.gaussians, grow_every=7))


def blurred() -> Capture:
    return tiny_moving(30_000)


CASES = {
    "both": (EvDynamicSplat, tiny_moving),
    "both, blurred": (EvDynamicSplat, blurred),
    "frames": (DynamicSplat, tiny_moving),
    "frames, blurred": (DynamicSplat, lambda: blurred().without(events=True)),
    "events": (EvDynamicSplat, lambda: tiny_moving().without(frames=True)),
}


@pytest.mark.parametrize("case", CASES)
def test_every_recipe_learns_from_whatever_there_is(case: str):
    recipe, capture = CASES[case]
    steps = 2 * STEPS if case == "events" else STEPS
    model = small(recipe).lasting(steps).build(capture(), 0)
    probe = [(step, model.draw(step)) for step in range(steps - 6, steps)]

    @torch.no_grad()
    def loss() -> float:
        return sum(float(sum(model.losses(batch, step).values())) for step, batch in probe)

    before = loss()
    fit(model, adam(model), steps=range(steps))
    assert loss() < 0.9 * before


def test_the_edi_phase_renders_single_instants_and_later_steps_exposures():
    model = small().build(blurred(), 0)
    late_from = model.heaviest_step
    early, late = model.draw(late_from - 1), model.draw(late_from)
    assert set(early) == {"views", "latent_frames"} and early["views"].shape == (2, 1)
    assert set(late) == {"views", "no_grad_views", "frames", "latent_frames", "events"}
    assert late["views"].shape == (2, 4) and late["no_grad_views"].shape == (2, 6)
    assert late["events"].shape == (2, 3, 16, 16, 1)
    assert len(set(late["views"].track[:, 0].tolist())) == 2, "two cameras"
    assert (late["views"].time == late["views"].time[:1]).all(), "at the same instants"
    assert set(model.losses(late, late_from)) == {"blur", "latent", "events", "reg", "lifespan"}
    assert set(model.losses(late, STEPS - 1)) == {"blur", "latent", "events"}, "growing has ended"


def test_of_sharp_frames_pairs_of_latent_frames_are_compared():
    model = small().build(tiny_moving(), 0)
    lengths = set()
    for step in range(model.heaviest_step, STEPS):
        batch = model.draw(step)
        assert set(batch) == {"views", "latent_frames", "events"} and batch["views"].shape == (2, 2)
        assert batch["events"].shape == (2, 1, 16, 16, 1) and batch["latent_frames"].shape == (
            2,
            16,
            16,
            2,
        )
        first, last = batch["views"].time[0].tolist()
        assert 0 <= first < last <= 1
        lengths.add(last - first)
    assert max(lengths) > 3 * min(lengths)


def test_counts_are_those_of_the_camera():
    """But for the parts of an event that light was on its way at either end."""
    capture = tiny_moving()
    model = small().build(capture, 0)
    drawn = [model.draw(step)["events"] for step in range(model.heaviest_step, STEPS)]
    seen = max(drawn, key=lambda seen: float((seen.end - seen.start).max()))
    events, clock = capture.needed_events, capture.clock
    assert events.track is not None
    for camera in range(2):
        first, last = (int(clock.us(float(t[camera, 0, 0, 0, 0]))) for t in (seen.start, seen.end))
        mine = (events.track == int(seen.track[camera, 0, 0, 0, 0])) & (events.p > 0)
        mine &= (events.t_us > first) & (events.t_us <= last)
        counts = np.zeros((16, 16))
        np.add.at(counts, (events.y[mine], events.x[mine]), 1)
        assert counts.max() >= 2
        assert np.abs(seen.positive[camera, 0, ..., 0].numpy() - counts).max() <= 1


def test_static_gaussians_learn_alone_at_first():
    model = small().build(tiny_moving(), 0)
    pose = model.path.pose(torch.full((1, 1), 0.5), torch.zeros(1, 1, dtype=torch.int64))
    corner = torch.zeros(1, 1, 2, dtype=torch.int64)
    views = Views(pose, torch.full((1, 1), 0.5), torch.ones(1, 1), corner, (16, 16))
    with torch.no_grad():
        first, later, done = (model.scene.draw(views, step=step).rgb for step in (0, 39, None))
    assert not torch.equal(first, later) and torch.equal(later, done)
    moving = next(group for group in model.groups() if group.name == "moving velocities")
    assert moving.rate(0) == 0 and moving.rate(39) > 0


def test_views_of_different_times_are_drawn_each_at_its_own():
    model = small().build(tiny_moving(), 0)
    time = torch.tensor([[0.2], [0.7]])
    pose = model.path.pose(time, torch.zeros(2, 1, dtype=torch.int64))
    corner = torch.zeros(2, 1, 2, dtype=torch.int64)
    with torch.no_grad():
        both = model.draw_views(Views(pose, time, torch.ones(2, 1), corner, (16, 16))).rgb
        for row in range(2):
            alone = render_view(model, model.capture.camera, pose[row, 0], float(time[row, 0]))
            torch.testing.assert_close(both[row, :, :, 0], alone.rgb)


def test_moving_ones_start_where_something_moves():
    """The hub of the rotor is at the origin, which frames alone always see it cover."""
    capture, _ = recentred(tiny_moving())
    by_events = moving_cells(capture, event_index(capture.needed_events), (0.3, 0.7))
    assert by_events is not None and by_events.norm(dim=-1).min() < 0.1
    by_frames = moving_cells(capture, None, (0.3, 0.7))
    assert by_frames is not None and 0 < len(by_frames) < len(by_events) < len(box_cells())
    assert moving_cells(capture, None, (0.30, 0.31)) is None, "no frame is there"
    moving = small().build(tiny_moving(), 0).scene.moving
    assert moving.centre_times.min() >= 0 and moving.centre_times.max() <= 1
    assert moving.centre_times.sort().values.diff().max() < 0.1, "at all times"


def test_the_backdrop_is_what_cameras_see_most_of_the_time():
    capture, _ = recentred(tiny_moving())
    images = backdrop(capture)
    frames = capture.needed_frames
    tracks = np.unique(frames.track[capture.split.train])
    assert len(images) == len(tracks)
    own = capture.split.train[frames.track[capture.split.train] == tracks[0]]
    middle = np.median(frames.images[own], 0) / frames.white
    np.testing.assert_allclose(images.light[0] ** (1 / 2.2), middle, atol=1e-4)


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_at_an_instant_the_scene_is_one_of_static_gaussians(sh_degree: int):
    gaussians = replace(EvDynamicSplat().gaussians, sh_degree=sh_degree, background=0.0)
    model = replace(small(), gaussians=gaussians).build(tiny_moving(), 0)
    pose = model.path.pose(torch.tensor(0.4), torch.tensor(0))
    view = whole(model.capture.camera, pose, 0.4)
    with torch.no_grad():
        frozen = model.scene.splatting(model.scene.gaussians_at(0.4), view)
        torch.testing.assert_close(frozen.rgb, model.draw_views(view).rgb)
    other = model.scene.gaussians_at(0.7)
    assert len(other) > len(model.scene.static) and other.sh_degree == sh_degree


def test_a_moving_run_is_exported_at_instants(tmp_path: Path):
    words = ("--preset", "draft", "--steps", 4, "--motion.lifespan-ms", 20, "--device", "cpu")
    write(tiny_moving(), tmp_path / "spinner")
    out = tmp_path / "run"
    assert run("train", "ev-dynamic-splat", tmp_path / "spinner", "--out", out, *words) == 0
    assert run("export", out, "--out", tmp_path / "one.ply", "--time", 60_000) == 0
    assert run("export", out, "--out", tmp_path / "all.ply", "--sequence", 3) == 0
    counts = [len(read_splats(tmp_path / f"{name}.ply").means) for name in ("one", "all_0001")]
    scene = open_run(out).model.scene
    assert all(
        len(scene.static) < count < len(scene.static) + len(scene.moving) for count in counts
    )
    assert not (tmp_path / "all_0003.ply").exists()
    assert run("export", out, "--out", tmp_path / "no.ply", "--time", 10**9) == 2


def test_it_is_a_model_that_grows_and_draws_views():
    model = small().build(tiny_moving(), 0)
    assert isinstance(model, Model | Growing | ViewRenderer | HasLogLight)
    with pytest.raises(OptionError, match="renders whole views"):
        model.render(Rays(torch.zeros(1, 3), torch.ones(1, 3), torch.ones(1), torch.ones(1)))


def test_thresholds_gains_and_offsets_can_be_learned():
    unknowns = LearnedCalibrationOptions(thresholds="signs", gains=True, offset=True)
    model = small(calibration=unknowns).build(tiny_moving(), 0)
    assert {"calibration", "offset"} <= {group.name for group in model.groups()}
    losses = model.losses(model.draw(STEPS - 1), STEPS - 1)
    assert {"thresholds", "prior"} <= losses.keys()
    sum(losses.values()).backward()
    assert model.calibration.offset_steps is not None
    assert model.calibration.offset_steps.grad.abs() > 0, "a stretch of events tells when it was"
    model.losses(model.draw(STEPS - 2), STEPS - 2)["blur"].backward()
    assert model.calibration.log_gain is not None and model.calibration.log_gain.grad is not None
    assert model.calibration.log_gain.grad.any(), "frames tell how long they were exposed"


@pytest.mark.parametrize("frames", [True, False])
def test_events_at_rectified_positions_are_learned_from(frames: bool):
    capture = tiny_moving().without(frames=not frames)
    events = capture.needed_events
    x, y = (np.clip(column + np.float32(0.25), 0, 15) for column in (events.x, events.y))
    rectified = replace(events, x=x.astype(np.float32), y=y.astype(np.float32))
    model = small().build(replace(capture, events=rectified), 0)
    assert model.sampler.cameras[0].index is None
    terms = model.losses(model.draw(STEPS - 1), STEPS - 1)
    terms["events"].backward()
    assert model.scene.moving.means.grad.any() and torch.isfinite(terms["events"])


@pytest.mark.parametrize("frames", [True, False])
def test_events_behind_a_colour_filter_are_learned_from(frames: bool):
    capture = tiny_moving().without(frames=not frames)
    coloured = replace(capture, events=replace(capture.needed_events, bayer="RGGB"))
    model = small().build(coloured, 0)
    batch = model.draw(STEPS - 1)
    assert batch["events"].shape[-1] == 3
    terms = model.losses(batch, STEPS - 1)
    terms["events"].backward()
    assert model.scene.moving.base_harmonics.grad.any() and torch.isfinite(terms["events"])


def test_a_capture_without_what_is_needed_is_refused():
    with pytest.raises(CaptureError, match="needs events"):
        small().build(tiny_moving().without(events=True), 0)
    with pytest.raises(CaptureError, match="needs frames"):
        small(DynamicSplat).build(tiny_moving().without(frames=True), 0)


def test_resuming_equals_never_having_stopped(tmp_path: Path):
    recipe, stop_at = small(), 26

    class Dying(SplatModel):
        def draw(self, step: int) -> Any:
            if step == stop_at:
                raise KeyboardInterrupt
            return super().draw(step)

    def dying(steps: int) -> SplatModel:
        model = recipe.build(tiny_moving(), 1)
        model.__class__ = Dying
        return model

    def go(folder: str, build: Any, *, resume: bool = False) -> bytes:
        options = TrainingOptions(checkpoint_every=5, resume=resume)
        train(build, tmp_path / folder, options, steps=STEPS, settings={}, console=quiet())
        return file_of(tmp_path / folder, "last").read_bytes()

    straight = go("straight", lambda steps: recipe.build(tiny_moving(), 1))
    with pytest.raises(KeyboardInterrupt):
        go("stopped", dying)
    assert go("stopped", lambda steps: recipe.build(tiny_moving(), 1), resume=True) == straight
