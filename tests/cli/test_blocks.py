"""Blocks one after the other, side by side under torchrun, and after a worker was killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sharpfield.captures.native.layout import write
from sharpfield.runs.run import open_run
from sharpfield.training.checkpoint import file_of
from sharpfield.training.status import read_status
from tests.captures.test_blocks import corridor
from tests.cli.command import run

STEPS = 30
TRAINED = ("--steps", str(STEPS), "--device", "cpu", "--checkpoint-every", "5")
SMALL = ("--change", "gaussians.cap_max=200", "sampling.frame_quality=even")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("blocks") / "corridor"
    write(corridor(), folder)
    return folder


@pytest.fixture(scope="module")
def alone(capture: Path) -> Path:
    out = capture.parent / "alone"
    assert run("blocks", "room-splat", str(capture), "--out", str(out), *TRAINED, *SMALL) == 0
    return out


def tensors(path: Path) -> bytes:
    return file_of(path, "last").read_bytes()


def test_blocks_become_one_run_of_what_lies_in_each(alone: Path):
    parts = [open_run(alone / "blocks" / name).model for name in ("1of2", "2of2")]
    whole = open_run(alone)
    found = len(whole.model.scene.static)
    assert 0 < found < sum(len(part.scene.static) for part in parts)
    assert whole.config.block == "" and len(whole.capture.split.train) == 32
    assert read_status(alone).finished


def test_a_finished_command_does_nothing_again(capture: Path, alone: Path):
    command = ("blocks", "room-splat", str(capture), "--out", str(alone), *TRAINED, *SMALL)
    before, merged = tensors(alone / "blocks" / "1of2"), file_of(alone, "last")
    written, whole = merged.stat().st_mtime_ns, tensors(alone)
    assert run(*command) == 0
    assert tensors(alone / "blocks" / "1of2") == before
    assert merged.stat().st_mtime_ns == written, "it is up to date"
    block = file_of(alone / "blocks" / "2of2", "last")
    os.utime(block, ns=(written + 1, written + 1))
    assert run(*command) == 0
    assert merged.stat().st_mtime_ns > written and tensors(alone) == whole, "a block is newer"


def test_finished_blocks_of_other_settings_are_refused(
    capture: Path, alone: Path, capsys: pytest.CaptureFixture[str]
):
    before = tensors(alone)
    others = (*TRAINED, *SMALL, "sampling.depth_weight=0.2")
    assert run("blocks", "room-splat", str(capture), "--out", str(alone), *others) == 2
    assert "depth" in capsys.readouterr().err
    assert tensors(alone) == before


def test_workers_side_by_side_one_of_them_killed_make_the_same(capture: Path, alone: Path):
    out = capture.parent / "together"
    command = [
        *(sys.executable, "-m", "torch.distributed.run", "--standalone"),
        *("--nproc-per-node", "2", "--max-restarts", "2", "-m", "sharpfield"),
        *("blocks", "room-splat", str(capture), "--out", str(out), *TRAINED, *SMALL),
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE) as started:
        assert _killed_after_a_checkpoint(out / "blocks" / "2of2", started)
        _, said = started.communicate(timeout=120)
    assert started.returncode == 0, said.decode()[-2000:]
    for part in ("blocks/1of2", "blocks/2of2", "."):
        one, other = (open_run(folder / part).model for folder in (alone, out))
        for name, values in one.scene.static.points().items():
            assert np.array_equal(values.detach(), other.scene.static.points()[name].detach())


def _killed_after_a_checkpoint(run_folder: Path, parent: subprocess.Popen) -> bool:
    """Kill the worker of a block once it has saved; False if that never happened."""
    until = time.monotonic() + 90
    while time.monotonic() < until and parent.poll() is None:
        if file_of(run_folder, "last").exists():
            for child in _children(parent.pid):
                if b"RANK=1\0" in Path(f"/proc/{child}/environ").read_bytes():
                    os.kill(child, signal.SIGKILL)
                    return True
        time.sleep(0.02)
    return False


def _children(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]
