"""Recipes of other packages: one that works, with a preset, beside one that cannot be loaded."""

import json
import sys
from pathlib import Path

import pytest

from sharpfield.core import plugins
from tests.cli.command import run

GOOD = '''
from dataclasses import dataclass, field, replace
from typing import ClassVar

from sharpfield.core.protocols import Paper
from sharpfield.recipes.settings.presets import Presets
from sharpfield.recipes.nerf import NeRF
from sharpfield.recipes.volume.scene import VolumeOptions


def few(recipe: "TheirNeRF") -> "TheirNeRF":
    """Few pixels."""
    return replace(recipe, pixels=16)


@dataclass(frozen=True)
class TheirNeRF(NeRF):
    """A recipe of another package."""

    paper: ClassVar[Paper] = Paper("their2030", "Theirs", "@article{their2030}")
    presets: ClassVar[Presets] = Presets(sizes={"few": few})
    threshold: float = 0.5
    """A field named as an option of the command."""
    volume: VolumeOptions = field(
        default_factory=lambda: VolumeOptions(kind="voxels", voxels=(0, 4000), samples=(16, 0))
    )
'''
ENTRY_POINTS = """
[sharpfield.recipes]
their-nerf = their_package.good:TheirNeRF
broken = their_package.bad:Missing
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package as a package manager would lay it down."""
    package, about = tmp_path / "their_package", tmp_path / "their_package-1.0.dist-info"
    package.mkdir(), about.mkdir()
    (package / "__init__.py").write_text("")
    (package / "good.py").write_text(GOOD)
    (package / "bad.py").write_text('raise RuntimeError("a bug of theirs")\n')
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    plugins._loaded.cache_clear()
    for name in [name for name in sys.modules if name.startswith("their_package")]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.usefixtures("installed")
def test_the_list_has_what_works_and_names_what_does_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("recipes", "list") == 0
    printed = capsys.readouterr()
    assert "their-nerf         A recipe of another package." in printed.out
    assert "ev-splat" in printed.out and "broken" not in printed.out
    (line,) = printed.err.splitlines()
    assert "broken = their_package.bad:Missing" in line and "a bug of theirs" in line


@pytest.mark.usefixtures("installed")
def test_the_good_one_is_described_trained_and_evaluated(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("recipes", "describe", "their-nerf") == 0
    described = capsys.readouterr().out
    assert "few" in described and "1024 -> 16" in described
    assert "A field named as an option of the command." in described
    out = tmp_path / "run"
    words = ("--preset", "few", "--steps", 2, "--recipe.threshold", 0.25, "--lr", 0.01)
    assert run("train", "their-nerf", recorded, "--out", out, *words) == 0
    options = json.loads((out / "recipe.json").read_text())["options"]
    assert (options["pixels"], options["threshold"], options["lr"]) == (16, 0.25, 0.01)
    assert run("evaluate", out) == 0
    assert json.loads((out / "metrics.json").read_text())["mean"]["psnr"] > 0


@pytest.mark.usefixtures("installed")
def test_the_broken_one_is_refused_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("recipes", "cite", "broken") == 2
    said = capsys.readouterr().err
    assert "unknown recipe" in said and "Traceback" not in said
