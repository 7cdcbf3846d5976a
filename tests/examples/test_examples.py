"""The examples run as a reader would run them, only smaller."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

RUNS = {
    "00_a_sharp_scene": (("--size", "24", "16", "--steps", "2"), "wrote a_sharp_scene.png"),
    "01_blur_it": (("--size", "24", "16"), "wrote blur_it.png"),
    "02_make_events": ((), "wrote events.png"),
    "04_your_capture": (("--size", "16", "12"), "divide them by 1000"),
    "05_your_paper": (("--size", "24", "16", "--steps", "25"), "step   24  blur"),
}
"""What each is run with, and what it says at the end."""

LINES = 60


@pytest.mark.parametrize("name", RUNS)
def test_runs(name: str, tmp_path: Path) -> None:
    options, said = RUNS[name]
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / f"{name}.py", *options],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    for line in done.stdout.splitlines():
        if line.startswith("wrote "):
            assert (tmp_path / line.split()[1]).stat().st_size > 0


def test_numbered_examples_are_all_run_and_short() -> None:
    numbered = sorted((ROOT / "examples").glob("[0-9]*.py"))
    assert {path.stem for path in numbered} == RUNS.keys()
    for path in numbered:
        assert code_lines(path) < LINES, path.name


def code_lines(path: Path) -> int:
    """Lines that are neither blank nor the docstring at the top."""
    text = path.read_text()
    first = ast.parse(text).body[0].end_lineno or 0
    return sum(bool(line.strip()) for line in text.splitlines()[first:])
