"""Runs of Gaussians through the commands: train, evaluate, render, export."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sharpfield.captures.native.layout import write
from sharpfield.captures.read import read_capture
from sharpfield.rendering.splat import Splatting, whole
from sharpfield.rendering.view import render_view
from sharpfield.runs.run import open_run
from sharpfield.storage.ply import read_splats
from tests.cli.command import run
from tests.fields.gaussians.ply_files import import_splats

SMALL = ("--steps", 4, "--change", "gaussians.cap_max=300")


@pytest.fixture(scope="module")
def trained(recorded: Path) -> Path:
    out = recorded.parent / "ev-splat"
    assert run("train", "ev-splat", recorded, "--out", out, *SMALL) == 0
    return out


@pytest.fixture(scope="module")
def from_events(recorded: Path) -> Path:
    out = recorded.parent / "event-splat"
    assert run("train", "event-splat", recorded, "--out", out, *SMALL) == 0
    return out


def test_evaluate_measures_a_run_of_gaussians(trained: Path) -> None:
    assert run("evaluate", trained) == 0
    metrics = json.loads((trained / "metrics.json").read_text())
    assert [view["name"] for view in metrics["views"]] == ["0000", "0004"]
    assert metrics["mean"]["psnr"] > 5 and metrics["train"]["steps"] == 4
    assert "<html" in (trained / "report.html").read_text()


def test_a_camera_that_reported_nothing_is_as_none(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = read_capture(recorded)
    write(replace(capture, events=capture.needed_events[:0]), tmp_path / "silent")
    words = ("--out", tmp_path / "run", *SMALL)
    assert run("train", "event-splat", tmp_path / "silent", *words) == 2
    assert "this needs events, and the capture has none" in capsys.readouterr().err
    assert run("train", "ev-splat", tmp_path / "silent", "--out", tmp_path / "frames", *SMALL) == 0
    assert run("evaluate", tmp_path / "frames") == 0


@pytest.mark.parametrize("kind", ["trained", "from_events"])
@pytest.mark.parametrize("path", ["spiral", "exposure:1"])
def test_render_draws_gaussians_along_every_path(
    kind: str, path: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Inside an exposure also where the model learned from events and never saw a frame."""
    words = ("--out", tmp_path / "images", "--path", path, "--frames", 2)
    assert run("render", request.getfixturevalue(kind), *words) == 0
    assert len(list((tmp_path / "images").glob("*.png"))) == 2


def test_what_is_exported_looks_the_same_in_the_captures_own_world(
    trained: Path, tmp_path: Path
) -> None:
    assert run("export", trained, "--out", tmp_path / "scene.ply") == 0
    opened = open_run(trained)
    model, capture = opened.model, opened.capture
    scene, world = import_splats(tmp_path / "scene.ply"), np.array([1])
    draw = Splatting(capture.camera, model.tone.decode)
    assert len(scene) == len(model.scene.static)
    with torch.no_grad():
        found = draw(scene, whole(capture.camera, capture.frame_pose(world)[0], 0.5))[0, ..., 0]
    seen = render_view(model, capture.camera, model.capture.frame_pose(world)[0], 0.5)
    torch.testing.assert_close(found.rgb, seen.rgb, atol=1e-3, rtol=0)
    inside = seen.opacity > 0.5
    assert inside.any() and not np.isclose(model.change.scale, 1)
    apart = (found.depth * model.change.scale - seen.depth)[inside]
    assert apart.abs().max() < 1e-3 * seen.depth.max()


def test_an_export_says_what_made_it_and_how_it_is_drawn(trained: Path, tmp_path: Path) -> None:
    assert run("export", trained, "--out", tmp_path / "scene.ply") == 0
    assert read_splats(tmp_path / "scene.ply").comments == ("sharpfield ev-splat", "antialiased")


def test_the_encoding_of_the_colours_can_be_said(trained: Path, tmp_path: Path) -> None:
    for encoding in ("srgb", "linear"):
        words = ("--out", tmp_path / f"{encoding}.ply", "--encoding", encoding)
        assert run("export", trained, *words) == 0
    assert run("export", trained, "--out", tmp_path / "own.ply") == 0
    shown, light, own = (
        read_splats(tmp_path / f"{name}.ply").harmonics for name in ("srgb", "linear", "own")
    )
    np.testing.assert_array_equal(own, shown)  # gamma is near enough
    assert light.mean() > shown.mean()


def test_a_run_without_gaussians_is_not_exported(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ("--change", "volume.voxels=0,4000", "volume.samples=16,0", "--preset", "draft")
    nerf = tmp_path / "nerf"
    assert run("train", "nerf", recorded, "--out", nerf, "--steps", 2, *small) == 0
    capsys.readouterr()
    assert run("export", nerf, "--out", tmp_path / "scene.ply") == 2
    assert capsys.readouterr().err == (
        "OptionError: this run holds no Gaussians\n"
        f"  where  {nerf}\n"
        "  got    the recipe nerf\n"
        "  do     export a run of one of the splat recipes; `sharpfield recipes` lists them\n"
    )
    assert not (tmp_path / "scene.ply").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("export", "nowhere", "--out", "x.ply"), "this is not a run"),
        (("export", "nowhere", "--out", "x.splat"), "name a file FILE.ply"),
    ],
)
def test_what_cannot_be_exported_is_said(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 2
    said = capsys.readouterr().err
    assert message in said and "Traceback" not in said


def test_resuming_equals_never_having_stopped(recorded: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    words = ("train", "ev-splat", recorded, "--out", again, *SMALL, "--checkpoint-every", 1)
    assert run(*words) == 0
    last = again / "checkpoints" / "last.safetensors"
    straight = last.read_bytes()
    (again / "checkpoints" / "previous.safetensors").replace(last)  # as if killed at step 3
    assert run(*words, "--resume") == 0
    assert last.read_bytes() == straight
