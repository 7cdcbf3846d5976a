"""The examples run as a reader would run them, only smaller."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

RUNS = {
    "01_a_sharp_scene": (("--size", "24", "16", "--steps", "2"), "wrote a_sharp_scene.png"),
    "02_blur_it": (("--size", "24", "16"), "wrote blur_it.png"),
    "03_make_events": ((), "wrote events.png"),
    "04_your_capture": (("--size", "16", "12"), "divide them by 1000"),
    "05_your_paper": (("--size", "24", "16", "--steps", "25"), "step   24  blur"),
}
"""What each is run with, and what it says at the end."""

TEN_LINES = ROOT / "examples" / "00_ten_lines.py"
NOTEBOOK = ROOT / "examples" / "from_capture_to_image.ipynb"
SMALLER = {"size=(120, 80), frames=18": "size=(24, 16), frames=5", "minutes=": "steps="}
"""How those examples are cut down that take no options."""

LINES = 60

SETTINGS = {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}


@pytest.mark.parametrize("name", RUNS)
def test_runs(name: str, tmp_path: Path) -> None:
    options, said = RUNS[name]
    done = python([ROOT / "examples" / f"{name}.py", *options], tmp_path)
    assert done.returncode == 0, done.stderr
    assert said in done.stdout
    for line in done.stdout.splitlines():
        if line.startswith("wrote "):
            assert (tmp_path / line.split()[1]).stat().st_size > 0


def test_ten_lines_do_everything(tmp_path: Path) -> None:
    text = smaller(TEN_LINES.read_text())
    done = python(["-c", text], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "held-out views" in done.stdout and (tmp_path / "ten_lines.ply").exists()
    assert (tmp_path / "runs" / "ten_lines" / "report.html").exists()
    imports = [line for line in text.splitlines() if line.startswith(("import", "from"))]
    assert imports == ["import sharpfield as sf"] and code_lines(TEN_LINES) <= 10


def test_the_notebook_runs_from_top_to_bottom(tmp_path: Path) -> None:
    book = json.loads(NOTEBOOK.read_text())
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    code = ["".join(one["source"]) for one in book["cells"] if one["cell_type"] == "code"]
    assert all(not one.get("outputs") for one in book["cells"])
    done = python(["-c", smaller("\n\n".join(code))], tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("EventStream(") == 2 and (tmp_path / "notebook.ply").exists()


def test_numbered_examples_are_all_run_and_short() -> None:
    numbered = sorted((ROOT / "examples").glob("[0-9]*.py"))
    assert {path.stem for path in numbered} == {TEN_LINES.stem, *RUNS}
    for path in numbered:
        assert code_lines(path) < LINES, path.name


def smaller(text: str) -> str:
    """An example at a size that takes seconds."""
    for long, short in SMALLER.items():
        assert long in text
        text = text.replace(long, short)
    return text


def python(words: list[str | Path], folder: Path) -> subprocess.CompletedProcess[str]:
    """What the interpreter says, run in a folder."""
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=os.environ
        | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
    )


def code_lines(path: Path) -> int:
    """Lines that are neither blank nor the docstring at the top."""
    text = path.read_text()
    first = ast.parse(text).body[0].end_lineno or 0
    return sum(bool(line.strip()) for line in text.splitlines()[first:])
