"""Help, versions, lists and mistakes are answered without importing what is heavy."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src")}
HEAVY = {"torch", "numba", "cv2", "matplotlib", "h5py", "av"}
WATCHED = """
import sys
from sharpfield.cli.commands import main
try:
    main(sys.argv[1:])
finally:
    print("imported", *(name for name in sys.modules if "." not in name))
"""


def answered(*words: str) -> tuple[subprocess.CompletedProcess[str], set[str]]:
    """What a command printed, and the packages that it imported."""
    call = [sys.executable, "-c", WATCHED, *words]
    done = subprocess.run(call, capture_output=True, text=True, env=SOURCE)
    said, _, imported = done.stdout.rpartition("imported ")
    return subprocess.CompletedProcess(words, done.returncode, said, done.stderr), {
        *imported.split()
    }


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 0, "make data"),
        (("--help",), 0, "calibrate"),
        (("--version",), 0, "sharpfield 0."),
        (("recipes",), 0, "room-splat"),
        (("recipes", "list"), 0, "ev-deblur-nerf     A sharp static scene"),
        (("recipes", "lst"), 2, "describe"),
        (("recipes", "describe", "ev-splt"), 2, "did you mean ev-splat"),
        (("trian", "ev-splat"), 2, "did you mean train"),
        (("train", "ev-splt", "garden", "--out", "run"), 2, "did you mean ev-splat"),
        (("simulate", "--out", "x", "--sizes", "8x8"), 2, "--size"),
        (("inspect",), 2, "PATH"),
        (("deblur", "x", "--out", "y", "--method", "exakt"), 2, "exact"),
        (("doctor", "x", "--jsn"), 2, "--json"),
        (("poses", "x"), 2, "--out"),
        (("calibrate", "x", "--out", "y", "--pairs", "many"), 2, "pairs"),
        (("train",), 2, "--out"),
        (("train", "ev-splat", "x"), 2, "--out"),
        (("train", "ev-splat", "x", "--out", "y", "--steps", "many"), 2, "steps"),
        (("train", "ev-splat", "x", "--out", "y", "--sampling.view", "3"), 2, "--sampling.views"),
        (("train", "nerf", "x", "--out", "y", "--lrr", "3"), 2, "did you mean --lr?"),
        (("train", "nerf", "x", "--out", "y", "--preset", "draught"), 2, "did you mean draft?"),
        (("train", "x", "--out", "y", "--minutes", "3"), 2, "unknown recipe"),
        (("blocks", "--out", "x"), 2, "PATH"),
        (("evaluate", "x", "--train-views", "all"), 2, "train-views"),
        (("render", "x", "--out", "y", "--fps", "fast"), 2, "fps"),
        (("events", "x", "--out", "y.h5", "--vieww", "3"), 2, "--view"),
        (("export", "x"), 2, "--out"),
        (("demo", "--minutes", "few"), 2, "minutes"),
    ],
)
def test_nothing_heavy_is_imported(words: tuple[str, ...], code: int, message: str) -> None:
    done, imported = answered(*words)
    assert done.returncode == code
    assert message in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert "tyro" in imported and not imported & HEAVY


def test_what_reads_the_help_may_stop_reading() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, "-m", "sharpfield", "--help"]
    done = subprocess.run(words, stdout=writing, stderr=subprocess.PIPE, text=True, env=SOURCE)
    os.close(writing)
    assert done.stderr == ""
