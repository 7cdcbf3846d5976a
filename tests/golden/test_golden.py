"""Every recipe still computes what it did when `golden.json` was written."""

import json
from pathlib import Path

import pytest

from tests.golden.golden import CAPTURES, CASES, FILE, numbers, simulated

GOLDEN = json.loads(FILE.read_text())
TOLERANCE = 1e-6


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("golden"))


def test_every_case_is_recorded():
    assert [f"{recipe} {preset}" for recipe, preset, _ in CASES] == list(GOLDEN)
    assert {capture for *_, capture in CASES} == set(CAPTURES)


@pytest.mark.parametrize(("recipe", "preset", "capture"), CASES)
def test_the_numbers_stay(captures: Path, tmp_path: Path, recipe: str, preset: str, capture: str):
    found = numbers(recipe, preset, captures / capture, tmp_path / "run")
    expected = GOLDEN[f"{recipe} {preset}"]
    assert found["parameters"] == expected["parameters"]
    for name in ("losses", "view", "metrics"):
        assert found[name] == pytest.approx(expected[name], rel=TOLERANCE, abs=TOLERANCE), name
