from pathlib import Path

import pytest

from tests.cli.command import run


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny capture, made by the command."""
    out = tmp_path_factory.mktemp("recorded") / "tiny"
    words = ("--scene", "tiles", "--size", "16x12", "--frames", 5, "--exposure-us", 20_000)
    assert run("simulate", "--out", out, *words, "--interval-us", 24_000, "--test-every", 4) == 0
    return out
