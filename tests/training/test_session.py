import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from rich.console import Console

from sharpfield.core.errors import RunError
from sharpfield.training.checkpoint import file_of, load
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import train
from sharpfield.training.status import TrainingStatus, read_status
from tests.training import toy
from tests.training.toy import Toy, quiet, score

SETTINGS = {"recipe": "toy", "seed": 0}


def run_toy(
    run: Path, options: TrainingOptions, *, build=Toy, validate=None, console=None
) -> TrainingStatus:
    return train(
        build,
        run,
        options,
        steps=30,
        settings=SETTINGS,
        validate=validate,
        console=console or quiet(),
    )


def dying_at(step: int, how=KeyboardInterrupt):
    """Builds a model that raises in the middle of a step."""

    def build(steps: int) -> Toy:
        model = Toy(steps)
        losses = model.losses

        def until(batch, now):
            if now == step:
                raise how
            return losses(batch, now)

        model.losses = until
        return model

    return build


def last_bytes(run: Path) -> bytes:
    return file_of(run, "last").read_bytes()


@pytest.fixture(scope="module")
def straight(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("straight")
    run_toy(run, TrainingOptions(checkpoint_every=7, validate_every=8), validate=score)
    return run


def test_a_run_leaves_its_folder_in_order(straight: Path):
    assert sorted(path.name for path in straight.iterdir()) == [
        "checkpoints",
        "log.csv",
        "tensorboard",
        "training.json",
    ]
    status = read_status(straight)
    assert status is not None and status.finished
    assert (status.steps, status.planned_steps, status.micro_batches, status.device) == (
        30,
        30,
        1,
        "cpu",
    )
    assert status.seconds > 0 and status.peak_memory_mb > 50
    assert load(file_of(straight, "last")).progress.step == 30
    assert load(file_of(straight, "previous")).progress.step == 28


@pytest.mark.parametrize("step", [0, 3, 10, 11, 29])
def test_resuming_equals_never_having_stopped(tmp_path: Path, straight: Path, step: int):
    options = TrainingOptions(checkpoint_every=7, validate_every=8)
    with pytest.raises(KeyboardInterrupt):
        run_toy(tmp_path, options, build=dying_at(step), validate=score)
    again = TrainingOptions(checkpoint_every=7, validate_every=8, resume=True)
    assert run_toy(tmp_path, again, validate=score).finished
    assert last_bytes(tmp_path) == last_bytes(straight)
    assert file_of(tmp_path, "best").read_bytes() == file_of(straight, "best").read_bytes()


def test_parts_are_remembered(tmp_path: Path):
    options = TrainingOptions(memory_gb=0.0004, checkpoint_every=7)
    wide = lambda steps: Toy(steps, measurements=4096)  # noqa: E731
    whole = run_toy(tmp_path / "a", options, build=wide)
    assert whole.micro_batches > 1

    class Dying(Toy):
        def draw(self, step):
            if step == 20:
                raise KeyboardInterrupt
            return super().draw(step)

    with pytest.raises(KeyboardInterrupt):
        run_toy(tmp_path / "b", options, build=lambda steps: Dying(steps, measurements=4096))
    resumed = run_toy(tmp_path / "b", TrainingOptions(resume=True), build=wide)
    assert resumed.micro_batches == whole.micro_batches
    assert last_bytes(tmp_path / "a") == last_bytes(tmp_path / "b")


def test_the_best_is_kept_and_scores_are_logged(straight: Path):
    best = load(file_of(straight, "best")).progress
    with (straight / "log.csv").open(newline="") as file:
        scores = [(row["step"], row["validation"]) for row in csv.DictReader(file)]
    scores = {int(step): float(value) for step, value in scores if value}
    assert list(scores) == [8, 16, 24, 30]
    assert best.best == pytest.approx(max(scores.values()), rel=1e-5)
    assert best.step == max(scores, key=lambda step: scores[step])


def test_minutes_end_with_a_finished_schedule(tmp_path: Path):
    slow = lambda steps: Toy(steps, seconds_per_step=0.005)  # noqa: E731
    begun = time.monotonic()
    status = run_toy(tmp_path, TrainingOptions(minutes=0.03), build=slow)
    assert time.monotonic() - begun < 3.5
    assert 30 < status.planned_steps < 360  # not the recipe's 30; 1.8 s of 5 ms and more
    assert status.steps > 0.5 * status.planned_steps
    if not status.finished:  # on a machine that grew slower on the way
        assert run_toy(tmp_path, TrainingOptions(minutes=0.5, resume=True)).finished
    assert load(file_of(tmp_path, "last")).progress.planned_steps == status.planned_steps


def test_time_that_is_up_stops_politely(tmp_path: Path, straight: Path):
    with pytest.raises(KeyboardInterrupt):
        run_toy(tmp_path, TrainingOptions(checkpoint_every=5, validate_every=8), build=dying_at(12))
    output = io.StringIO()
    console = Console(file=output, width=40)
    stopped = run_toy(tmp_path, TrainingOptions(minutes=1e-9, resume=True), console=console)
    assert (stopped.steps, stopped.planned_steps) == (10, 30)
    assert output.getvalue().splitlines()[-1] == (
        "Stopped after step 10 of 30: the time is up."
        " Saved; to go on from here, train again with --resume (resume=True)."
    )
    assert run_toy(tmp_path, TrainingOptions(resume=True)).finished
    assert (
        load(file_of(tmp_path, "last")).tensors.keys()
        == load(file_of(straight, "last")).tensors.keys()
    )


def test_seconds_add_up_over_sessions(tmp_path: Path):
    slow = lambda steps: Toy(steps, seconds_per_step=0.02)  # noqa: E731
    run_toy(tmp_path, TrainingOptions(steps=5), build=slow)
    first = read_status(tmp_path)
    second = run_toy(tmp_path, TrainingOptions(steps=10, resume=True), build=slow)
    assert first is not None and second.seconds >= first.seconds + 0.1
    assert second.steps == second.planned_steps == 10


def test_a_finished_run_has_nothing_left_to_do(tmp_path: Path):
    first = run_toy(tmp_path, TrainingOptions())
    before = last_bytes(tmp_path)
    again = run_toy(tmp_path, TrainingOptions(resume=True), build=dying_at(30))
    assert again.finished and again.steps == first.steps and last_bytes(tmp_path) == before


def test_a_loss_that_is_not_finite_leaves_the_good_checkpoint(tmp_path: Path):
    class Exploding(Toy):
        def losses(self, batch, step):
            factor = float("nan") if step == 17 else 1.0
            return {name: factor * loss for name, loss in super().losses(batch, step).items()}

    with pytest.raises(RunError, match="the loss 'colour' and 'grid' is not finite\n.*step 17"):
        run_toy(tmp_path, TrainingOptions(checkpoint_every=1), build=Exploding)
    saved = load(file_of(tmp_path, "last"))
    assert saved.progress.step == 17  # steps 0 to 16 are done
    assert all(torch.isfinite(tensor).all() for tensor in saved.tensors.values())
    assert run_toy(tmp_path, TrainingOptions(resume=True)).finished


def test_a_folder_that_holds_a_run_is_refused(straight: Path):
    with pytest.raises(RunError) as error:
        run_toy(straight, TrainingOptions())
    assert str(error.value).splitlines() == [
        "RunError: the folder already holds a run",
        f"  where  {straight}",
        "  do     go on with it by --resume (resume=True), or name another folder",
    ]


def test_other_settings_are_refused(straight: Path):
    with pytest.raises(RunError, match="seed: 0 before, 1 now"):
        train(
            Toy, straight, TrainingOptions(resume=True), steps=30, settings=SETTINGS | {"seed": 1}
        )


def test_a_damaged_status_is_named(tmp_path: Path):
    run_toy(tmp_path, TrainingOptions(steps=2))
    (tmp_path / "training.json").write_text('{"steps": ')
    with pytest.raises(RunError, match="the status of the training cannot be read"):
        run_toy(tmp_path, TrainingOptions(resume=True))


def start_process(run: Path, *more: str, steps: int = 30) -> subprocess.Popen:
    source = str(Path(toy.__file__).parents[2] / "src")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": source}
    command = [sys.executable, toy.__file__, str(run), str(steps), "0.05", *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def wait_for(process: subprocess.Popen, run: Path, step: int) -> None:
    """Until the process has saved so many steps."""
    for _ in range(4000):
        status = run / "training.json"
        if status.exists() and json.loads(status.read_text())["steps"] >= step:
            return
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.005)
    raise AssertionError("the process has not come that far")


def test_killed_and_resumed_equals_never_having_stopped(tmp_path: Path, straight: Path):
    for step in (4, 15):
        process = start_process(tmp_path, "--resume")
        wait_for(process, tmp_path, step)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        process.stdout.close()
        load(file_of(tmp_path, "last"))  # whole, whenever the kill came
    status = run_toy(tmp_path, TrainingOptions(resume=True))
    assert status.finished
    here, there = (load(file_of(run, "last")).tensors for run in (tmp_path, straight))
    assert here.keys() == there.keys()
    assert all(torch.equal(here[name], there[name]) for name in here)


def test_terminated_it_saves_and_says_how_to_go_on(tmp_path: Path):
    process = start_process(tmp_path, steps=300)
    wait_for(process, tmp_path, 3)
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=20)
    assert process.returncode != 0  # so that what was to follow does not
    step = load(file_of(tmp_path, "last")).progress.step
    assert 3 <= step < 300
    assert f"Stopped after step {step} of 300: interrupted by SIGTERM." in said
    assert "--resume" in said
