"""Both recipes are trained for a time and scored."""

from pathlib import Path

import pytest

from benchmarks.plateau import RACES, round_of
from sharpfield.captures.native import layout as native
from sharpfield.core.capture import Capture
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from tests.recipes.moving import tiny_moving


def tiny_shaken() -> Capture:
    timing = Timing(frames=5, exposure_us=40_000, interval_us=50_000)
    return simulate("tiles", "shaky", rig=Rig((24, 16)), timing=timing)


@pytest.mark.parametrize(
    ("name", "made"), [("ev-splat", tiny_shaken), ("evdnerf-physical", tiny_moving)]
)
def test_a_round_is_a_run_with_its_score(name: str, made, tmp_path: Path) -> None:
    native.write(made(), tmp_path / "capture")
    row = round_of(name, 0.1, tmp_path / "capture", tmp_path / "run", "cpu")
    assert row[RACES[name].score] > 0 and row["minutes"] == 0.1
    assert (tmp_path / "run" / "report.html").exists()
