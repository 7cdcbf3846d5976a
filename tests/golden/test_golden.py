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


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "recipe" in metafunc.fixturenames:
        every = metafunc.config.getoption("golden")
        cases = [case for case in CASES if every or f"{case[0]} {case[1]}" in QUICK]
        metafunc.parametrize(("recipe", "preset", "capture"), cases)


def test_the_numbers_stay(captures: Path, tmp_path: Path, recipe: str, preset: str, capture: str):
    found = numbers(recipe, preset, captures / capture, tmp_path / "run")
    expected = GOLDEN[f"{recipe} {preset}"]
    assert found["parameters"] == expected["parameters"]
    for name in ("losses", "view", "metrics"):
        assert found[name] == pytest.approx(expected[name], rel=TOLERANCE, abs=TOLERANCE), name
