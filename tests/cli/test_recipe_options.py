"""Options of a recipe on the command line: flags, presets, old spellings, mistakes."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.cli.command import run

TINY = ("--volume.voxels", 0, 4000, "--volume.samples", 16, 0, "--pixels", 16, "--steps", 1)


def trained(capture: Path, out: Path, *words: object) -> dict[str, Any]:
    """The options that a run was started with."""
    assert run("train", "nerf", capture, "--out", out, "--preset", "draft", *TINY, *words) == 0
    return json.loads((out / "recipe.json").read_text())["options"]


def test_flags_win_over_presets(recorded: Path, tmp_path: Path) -> None:
    options = trained(recorded, tmp_path / "run", "--tv-weight=0.5", "--volume.clear_before", 0.1)
    assert options["volume"]["kind"] == "voxels", "the preset's"
    assert options["volume"]["voxels"] == [0, 4000] and options["pixels"] == 16
    assert options["tv_weight"] == 0.5 and options["volume"]["clear_before"] == 0.1


def test_flags_may_stand_before_the_capture(recorded: Path, tmp_path: Path) -> None:
    words = ("--out", tmp_path / "run", "--preset", "draft", *TINY)
    assert run("train", *words, "nerf", recorded) == 0


def test_change_still_works_and_names_the_flags(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--change", "volume.octaves=3,2", "lr_decay_steps=7")
    options = trained(recorded, tmp_path / "run", *words)
    assert options["volume"]["octaves"] == [3, 2] and options["lr_decay_steps"] == 7
    said = capsys.readouterr().err.splitlines()
    assert said == ["note: --change will go; write --volume.octaves 3 2 --lr-decay-steps 7"]


def test_old_names_of_options_are_accepted_with_a_hint(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = trained(recorded, tmp_path / "run", "--grids-faster", 2, "--decay=7")
    assert options["grid_lr_factor"] == 2 and options["lr_decay_steps"] == 7
    assert capsys.readouterr().err.splitlines() == [
        "note: the option --grids-faster is now --grid-lr-factor",
        "note: the option --decay is now --lr-decay-steps",
    ]


def test_old_names_of_presets_are_accepted_with_a_hint(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("train", "hybrid", "nowhere", "--out", "x", "--preset", "no-pictures") == 2
    said = capsys.readouterr().err
    assert said.startswith("note: the preset no-pictures is now no-images\n")
    assert "capture not found" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("train", "nerf", "x", "--out", "y", "--volume.octave", 3), "--volume.octaves"),
        (("train", "nerf", "x", "--out", "y", "--pixels", "many"), "pixels"),
        (("train", "nerf", "x", "--out", "y", "--preset", "draught"), "did you mean draft?"),
        (("train", "nerff", "x", "--out", "y"), "did you mean nerf"),
        (("simulate", "--out", "x", "--scene", "gardn"), "did you mean garden?"),
        (("train", "nerf", "x", "--out", "y", "--change", "pixel=3"), "did you mean pixels?"),
    ],
)
def test_mistyped_names_are_answered_with_similar_ones(
    words: tuple[object, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 2
    said = capsys.readouterr().err
    assert message in said and "Traceback" not in said


def test_the_help_lists_the_options_of_the_recipe_with_presets_applied(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    for words, default in ((), "(default: 1024)"), (("--preset", "draft"), "(default: 0.2)"):
        assert run("train", "nerf", *words, "--help") == 0
        said = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert "--volume.clear-before" in said and "floaters" in said
        assert default in said
