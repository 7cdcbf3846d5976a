import csv
import io
from pathlib import Path

import torch
from rich.console import Console

from sharpfield.training import log as log_module
from sharpfield.training.log import CsvTable, LogLosses, TrainingLog
from sharpfield.training.optim import adam
from tests.training.toy import Toy, quiet


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "log.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def open_log(run: Path, *, begin: int = 0, end: int = 10, seconds: float = 0.0) -> TrainingLog:
    return TrainingLog(run, begin=begin, end=end, seconds=seconds, console=quiet())


def test_rows_come_back(tmp_path: Path):
    with open_log(tmp_path) as log:
        log.record(5, {"total": 1.5, "blur": 1.0})
        log.record(10, {"total": 0.123456789, "blur": 0.1})
    assert [(row["step"], row["total"], row["blur"]) for row in rows(tmp_path)] == [
        ("5", "1.5", "1.0"),
        ("10", "0.123457", "0.1"),
    ]


def test_a_new_term_adds_a_column(tmp_path: Path):
    with open_log(tmp_path) as log:
        log.record(1, {"total": 1.0, "blur": 1.0})
        log.record(2, {"total": 1.0, "blur": 0.5, "events": 0.5})
        log.record(2, {"validation": 20.0})
    assert list(rows(tmp_path)[0]) == ["step", "seconds", "total", "blur", "events", "validation"]
    assert [row["events"] for row in rows(tmp_path)] == ["", "0.5", ""]
    assert [row["validation"] for row in rows(tmp_path)] == ["", "", "20.0"]


def test_resuming_drops_what_was_lost(tmp_path: Path):
    with open_log(tmp_path) as log:
        for step in (2, 4, 6):
            log.record(step, {"total": float(step)})
    with (tmp_path / "log.csv").open("a") as file:
        file.write("8,0.")  # torn by a kill
    with open_log(tmp_path, begin=4) as log:
        log.record(6, {"total": 60.0})
    assert [(row["step"], row["total"]) for row in rows(tmp_path)] == [
        ("2", "2.0"),
        ("4", "4.0"),
        ("6", "60.0"),
    ]


def test_a_table_of_nothing_has_its_header(tmp_path: Path):
    CsvTable(tmp_path / "log.csv", keep_to=0)
    assert (tmp_path / "log.csv").read_text().strip() == "step,seconds,total"


def test_seconds_go_on_over_sessions(tmp_path: Path):
    with open_log(tmp_path, seconds=100.0) as log:
        assert 100 <= log.seconds < 101


def test_logged_losses_are_means_over_the_steps_between(tmp_path: Path):
    model = Toy(1)
    optimizer = adam(model)
    with open_log(tmp_path, end=5) as log:
        hook = LogLosses(log, every=2)
        for step in range(5):
            losses = {"blur": torch.tensor(float(step))}
            if step >= 3:
                losses["events"] = torch.tensor(8.0)
            hook(step, model, optimizer, losses)
    assert [(row["step"], row["total"], row["blur"]) for row in rows(tmp_path)] == [
        ("2", "0.5", "0.5"),
        ("4", "10.5", "2.5"),
        ("5", "12.0", "4.0"),
    ]


def test_where_nobody_watches_lines_are_rare(tmp_path: Path, monkeypatch):
    output = io.StringIO()
    console = Console(file=output, force_terminal=False, width=40)
    now, model = 0.0, Toy(1)
    optimizer = adam(model)
    monkeypatch.setattr(log_module.time, "monotonic", lambda: now)
    with TrainingLog(tmp_path, begin=0, end=100, seconds=0.0, console=console) as log:
        hook = LogLosses(log, every=1)
        for step in range(100):
            now += 0.5
            hook(step, model, optimizer, {"blur": torch.tensor(0.125)})
    lines = output.getvalue().splitlines()
    assert len(lines) == 5  # 50 seconds, one line each 10
    assert lines[-1] == "step 100/100  2.0 steps/s  0 s left  total 0.125  blur 0.125"


def test_tensorboard_gets_the_same_numbers(tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with open_log(tmp_path) as log:
        log.record(3, {"total": 0.5})
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("total")] == [(3, 0.5)]


def test_without_tensorboard_there_is_still_the_table(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(log_module.importlib.util, "find_spec", lambda name: None)
    with open_log(tmp_path) as log:
        log.record(3, {"total": 0.5})
    assert not (tmp_path / "tensorboard").exists() and len(rows(tmp_path)) == 1
