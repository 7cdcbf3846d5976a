"""The commands as a user types them: what they write, what they print, how they refuse."""

import csv
import json
import os
import signal
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from tests.cli.command import run

SMALL = ("--change", "volume.voxels=0,4000", "volume.samples=16,0", "events.pairs=32")


@pytest.fixture(scope="module")
def trained(recorded: Path) -> Path:
    """A run of four steps on it."""
    out = recorded.parent / "run"
    words = ("--out", out, "--preset", "draft", "--steps", 4, *SMALL)
    assert run("train", "ev-deblur-nerf", recorded, *words) == 0
    return out


def test_inspect_keeps_its_contract(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("inspect", recorded, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "capture"
    assert {"count", "on", "t_first_us", "t_last_us", "width", "height"} <= found["events"].keys()
    assert found["frames"]["count"] == 5
    assert (found["frames"]["blurry"], found["frames"]["sharp"]) == (3, 2)
    assert (found["frames"]["width"], found["frames"]["height"]) == (16, 12)
    assert run("inspect", recorded / "events.h5", "--json") == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["kind"] == "events"
    assert alone["events"]["count"] == found["events"]["count"]


@pytest.mark.parametrize(("rig", "kind"), [("ring", "Still"), ("hand", "Tracks")])
def test_simulate_puts_cameras_around_what_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], rig: str, kind: str
) -> None:
    out = tmp_path / "arm"
    words = ("--scene", "arm", "--rig", rig, "--views", 3, "--held-out", 2, "--size", "16x16")
    timing = ("--frames", 3, "--interval-us", 20_000, "--step-us", 5_000)
    assert run("simulate", "--out", out, *words, *timing) == 0
    assert "events are in" in capsys.readouterr().out
    assert run("inspect", out, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    cameras = 3 if rig == "ring" else 1
    assert found["trajectory"]["kind"] == kind and found["trajectory"]["tracks"] == cameras + 2
    assert len(found["events"]["count_by_track"]) == cameras
    assert found["test_events"]["count"] > 0 and found["frames"]["with_flow"]
    assert found["frames"]["count"] == 3 * (cameras + 2) and found["frames"]["blurry"] == 0


def test_simulate_writes_evdnerfs_layout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "arm"
    words = ("--scene", "jelly", "--views", 2, "--size", "16x16", "--frames", 3)
    timing = ("--interval-us", 500_000, "--step-us", 50_000, "--layout", "evdnerf")
    assert run("simulate", "--out", out, *words, *timing) == 0
    capsys.readouterr()
    assert run("inspect", out, "--json", "--trust-pickle") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["layout"] == "evdnerf" and found["frames"]["count"] == 12


def test_only_layouts_with_pickled_files_can_be_trusted(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("inspect", recorded, "--trust-pickle") == 2
    assert "the layout native has no option trust_pickle" in capsys.readouterr().err


def test_simulate_writes_the_published_layout(tmp_path: Path, recorded: Path) -> None:
    out = tmp_path / "published"
    words = ("--scene", "tiles", "--size", "16x12", "--frames", 5, "--exposure-us", 20_000)
    assert run("simulate", "--out", out, "--layout", "ev-deblur-nerf", *words) == 0
    assert (out / "images_1" / "timestamps.npz").is_file()
    assert (out / "all_poses_bounds.npy").is_file()


def test_simulate_has_lenses_and_rolling_shutters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--size", "16x12", "--frames", 3, "--rolling-shutter-ms", 22, "--lens", "fisheye")
    shape = ("--distortion", -0.02, 0.01, 0, 0)
    assert run("simulate", "--out", tmp_path / "fish", "--scene", "tiles", *words, *shape) == 0
    about = (tmp_path / "fish" / "capture.toml").read_text()
    assert "row_delay_us = 2000.0" in about and 'lens = "fisheye"' in about
    assert run("simulate", "--out", tmp_path / "arm", "--scene", "arm", *words[-4:-2]) != 0
    assert "scenes that stand still" in capsys.readouterr().err


def test_deblur_writes_images(recorded: Path, tmp_path: Path) -> None:
    assert run("deblur", recorded, "--out", tmp_path / "sharp") == 0
    assert len(list((tmp_path / "sharp").glob("*.png"))) == 3 + 1  # and the contact sheet


def test_evaluate_keeps_its_contract(trained: Path) -> None:
    assert run("evaluate", trained) == 0
    metrics = json.loads((trained / "metrics.json").read_text())
    assert metrics.keys() >= {"protocol", "mean", "views", "train"}
    assert metrics["mean"].keys() >= {"psnr", "ssim", "ssim_paper", "lpips"}
    assert [view["name"] for view in metrics["views"]] == ["0000", "0004"]
    assert metrics["train"]["steps"] == 4
    assert metrics["train"].keys() >= {"seconds", "peak_memory_mb"}
    assert "<html" in (trained / "report.html").read_text()


def test_evaluate_can_refine_the_poses_first(trained: Path) -> None:
    assert run("evaluate", trained, "--refine", "--steps", 2, "--pixels", 8, "--every", 1) == 0
    protocol = json.loads((trained / "metrics.json").read_text())["protocol"]
    assert protocol["pose_refinement"]


def test_render_makes_a_video_and_images(trained: Path, tmp_path: Path) -> None:
    assert run("render", trained, "--out", tmp_path / "video.mp4", "--frames", 3) == 0
    assert (tmp_path / "video.mp4").stat().st_size > 0
    words = ("--path", "exposure:1", "--images", 2)
    assert run("render", trained, "--out", tmp_path / "inside", *words) == 0
    assert len(list((tmp_path / "inside").glob("*.png"))) == 2


def test_held_out_views_are_scored_while_training(
    recorded: Path, trained: Path, tmp_path: Path
) -> None:
    """Which changes nothing that is learned."""
    words = ("--preset", "draft", "--steps", 4, *SMALL, "--validate-every", 2)
    assert run("train", "ev-deblur-nerf", recorded, "--out", tmp_path / "run", *words) == 0
    with (tmp_path / "run" / "log.csv").open() as log:
        scores = {row["step"]: row["validation"] for row in csv.DictReader(log)}
    assert run("evaluate", tmp_path / "run") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert float(scores["4"]) == pytest.approx(metrics["mean"]["psnr"], abs=1e-3)
    assert float(scores["2"]) > 0
    last = Path("checkpoints") / "last.safetensors"
    assert (tmp_path / "run" / last).read_bytes() == (trained / last).read_bytes()
    assert (tmp_path / "run" / "checkpoints" / "best.safetensors").is_file()


def test_an_interrupted_training_says_so_to_what_would_follow(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(import_module("sharpfield.training.session"), "fit", interrupted)
    words = ("--preset", "draft", "--steps", 4, *SMALL)
    assert run("train", "ev-deblur-nerf", recorded, "--out", tmp_path / "run", *words) == 130


def test_resuming_equals_never_having_stopped(recorded: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    words = ("train", "ev-deblur-nerf", recorded, "--out", again, "--preset", "draft", *SMALL)
    assert run(*words, "--steps", 4, "--checkpoint-every", 1) == 0
    last = again / "checkpoints" / "last.safetensors"
    straight = last.read_bytes()
    (again / "checkpoints" / "previous.safetensors").replace(last)  # as if killed at step 3
    assert run(*words, "--resume", "--checkpoint-every", 1) == 0
    assert last.read_bytes() == straight


def test_recipes_speak(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("recipes") == 0
    assert "ev-deblur-nerf" in capsys.readouterr().out
    assert run("recipes", "describe", "ev-deblur-nerf") == 0
    assert "events.pairs" in capsys.readouterr().out
    assert run("recipes", "cite", "ev-deblur-nerf") == 0
    cited = capsys.readouterr().out
    assert "Cannici" in cited
    assert "- Samples are sorted after the networks" in cited


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("inspect", "nowhere"), "capture not found"),
        (("evaluate", "nowhere"), "this is not a run"),
        (("render", "nowhere", "--out", "x.mp4"), "this is not a run"),
        (("simulate", "--out", "x", "--size", "big"), "cannot read the size"),
        (("simulate", "--out", "x", "--scene", "moon"), "unknown scene"),
        (("recipes", "describe", "nerff"), "unknown recipe"),
    ],
)
def test_what_the_user_can_mend_ends_with_code_2(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 2
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said


def test_an_unknown_number_of_a_recipe_is_named(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--out", recorded.parent / "never", "--change", "event.pairs=3")
    assert run("train", "ev-deblur-nerf", recorded, *words) == 2
    said = capsys.readouterr().err
    assert "event.pairs" in said
    assert "did you mean events.pairs" in said
    assert not (recorded.parent / "never").exists()


def test_nanoseconds_taken_for_microseconds_are_noticed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "published"
    words = ("--scene", "tiles", "--size", "16x12", "--frames", 5, "--exposure-us", 20_000)
    assert run("simulate", "--out", out, "--layout", "ev-deblur-nerf", *words) == 0
    stamps = out / "all_timestamps.npy"
    np.save(stamps, np.load(stamps) * 1000)
    capsys.readouterr()
    assert run("inspect", out) == 2
    assert "ns" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_one_message(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    assert run("deblur", recorded, "--out", tmp_path / "file" / "sharp") == 2
    said = capsys.readouterr().err
    assert str(tmp_path / "file") in said and "Traceback" not in said
