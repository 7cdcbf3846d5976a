"""Every recipe still computes what it did when `golden.json` was written."""

import json
from pathlib import Path

import pytest

from tests.golden.golden import CAPTURES, CASES, FILE, numbers, simulated

GOLDEN = json.loads(FILE.read_text())
TOLERANCE = 1e-6
QUICK = {"nerf draft", "ev-deblur-nerf physical,draft", "ev-splat draft", "hybrid draft"}
QUICK |= {"evdnerf draft", "evdnerf-physical draft", "ev-dynamic-splat draft", "room-splat draft"}
"""Cases of every run of the tests; `pytest tests/golden --golden` computes all, in two minutes."""


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("golden"))


def test_every_case_is_recorded():
    assert [f"{recipe} {preset}" for recipe, preset, _ in CASES] == list(GOLDEN)
    assert {capture for *_, capture in CASES} == set(CAPTURES)
    assert set(GOLDEN) > QUICK


@pytest.mark.parametrize(("recipe", "preset", "capture"), CASES)
def test_the_numbers_stay(
    request: pytest.FixtureRequest,
    captures: Path,
    tmp_path: Path,
    recipe: str,
    preset: str,
    capture: str,
):
    if f"{recipe} {preset}" not in QUICK and not request.config.getoption("golden"):
        pytest.skip("computed with --golden")
    found = numbers(recipe, preset, captures / capture, tmp_path / "run")
    expected = GOLDEN[f"{recipe} {preset}"]
    assert found["parameters"] == expected["parameters"]
    for name in ("losses", "view", "metrics"):
        assert found[name] == pytest.approx(expected[name], rel=TOLERANCE, abs=TOLERANCE), name
