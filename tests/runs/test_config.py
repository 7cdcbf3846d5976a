import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sharpfield.core.errors import OptionError, RunError
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF
from sharpfield.recipes.nerf import NeRF
from sharpfield.recipes.volume.scene import VolumeOptions
from sharpfield.runs.config import FILE, RunConfig, from_table, read_run_config, write_run_config

PLAIN = RunConfig("ev-deblur-nerf", EvDeblurNeRF(), "data/garden", 7)
CHANGED = RunConfig(
    "ev-deblur-nerf",
    replace(
        EvDeblurNeRF(),
        steps=123,
        events=replace(EvDeblurNeRF().events, threshold=(0.25, 0.3)),
        volume=VolumeOptions(voxels=(8, 64), space="metric"),
    ),
    "data/garden",
    8,
    ("events",),
)
OTHER = RunConfig("nerf", NeRF(lr=1e-3), "a folder/with spaces", 0, ("frames",))


@pytest.mark.parametrize("started", [PLAIN, CHANGED, OTHER])
def test_what_is_written_is_read(tmp_path: Path, started: RunConfig):
    write_run_config(tmp_path, started)
    assert read_run_config(tmp_path) == started
    write_run_config(tmp_path, PLAIN)  # over it
    assert read_run_config(tmp_path) == PLAIN


def test_it_is_json_that_people_can_read(tmp_path: Path):
    write_run_config(tmp_path, CHANGED)
    table = json.loads((tmp_path / FILE).read_text())
    assert table["recipe"] == "ev-deblur-nerf" and table["use"] == ["events"]
    assert table["options"]["events"]["threshold"] == [0.25, 0.3]
    assert [p.name for p in tmp_path.iterdir()] == [FILE]


def test_options_that_were_not_written_take_their_defaults():
    found = from_table(EvDeblurNeRF, {"steps": 5, "events": {"pairs": 9}})
    wanted = EvDeblurNeRF(steps=5, events=replace(EvDeblurNeRF().events, pairs=9))
    assert found == wanted


def test_a_folder_that_is_not_a_run(tmp_path: Path):
    with pytest.raises(RunError) as refused:
        read_run_config(tmp_path)
    assert str(refused.value) == (
        "RunError: this is not a run\n"
        f"  where  {tmp_path}\n"
        "  got    no recipe.json\n"
        "  do     name a folder that `train` made"
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"options": {"stepz": 5}}, "EvDeblurNeRF has no option stepz"),
        ({"options": {"events": {"pear": 5}}}, "EventOptions has no option pear"),
        ({"seed": "seven"}, "invalid literal"),
    ],
)
def test_a_damaged_run_says_what_is_wrong(tmp_path: Path, change: dict[str, Any], said: str):
    (tmp_path / FILE).write_text(json.dumps({**PLAIN.settings(), **change}))
    with pytest.raises(RunError, match=said) as refused:
        read_run_config(tmp_path)
    assert str(refused.value).startswith(f"RunError: cannot be read\n  where  {tmp_path / FILE}\n")


@pytest.mark.parametrize("text", ["", '{"recipe": "nerf", ', "[]", '{"recipe": "nerf"}'])
def test_half_a_file_is_refused(tmp_path: Path, text: str):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(RunError, match="cannot be read"):
        read_run_config(tmp_path)


def test_an_unknown_recipe_is_named(tmp_path: Path):
    (tmp_path / FILE).write_text(json.dumps({**PLAIN.settings(), "recipe": "nerve"}))
    with pytest.raises(OptionError, match="nerve"):
        read_run_config(tmp_path)
