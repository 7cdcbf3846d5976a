"""The Python of the front page does what it says, at a size that a test can wait for."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.docs.test_docs import ROOT, blocks

SMALLER = {"size=(120, 80), frames=18": "size=(24, 16), frames=6", "minutes=2": "steps=20"}


def test_the_lines_of_the_front_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = blocks(ROOT / "README.md", "python")
    for written, quick in SMALLER.items():
        assert written in code
        code = code.replace(written, quick)
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    assert [line for line in code.splitlines() if "import" in line] == ["import sharpfield as sf"]
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)  # noqa: S102 - it is our own page
    assert names["sharp"].shape == names["blurry"].shape == (16, 24, 3)
    assert np.abs(names["sharp"] - names["blurry"]).max() > 0
    assert len(names["events"]) and names["scores"]["mean"]["psnr"] > 10
    metrics = json.loads((tmp_path / "runs/garden/metrics.json").read_text())
    assert metrics["mean"]["psnr"] == names["scores"]["mean"]["psnr"]
    assert (tmp_path / "garden.ply").stat().st_size > 1000
