import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from sharpfield.core.errors import RunError
from sharpfield.training.checkpoint import (
    TrainingProgress,
    check_settings,
    file_of,
    load,
    recover,
    restore,
    restore_weights,
    save_best,
    save_last,
)
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from tests.training.toy import Toy

SETTINGS = {"recipe": "toy", "samples": (64, 128)}


@pytest.fixture
def trained():
    model = Toy(20)
    optimizer = adam(model)
    fit(model, optimizer, steps=range(12))
    return model, optimizer


def save(run: Path, trained, step: int) -> None:
    save_last(run, *trained, TrainingProgress(step, 20, settings=SETTINGS))


def test_what_is_saved_comes_back(tmp_path: Path, trained):
    model, optimizer = trained
    save_last(tmp_path, *trained, TrainingProgress(12, 20, 3, best=1 / 3, settings=SETTINGS))
    saved = load(file_of(tmp_path, "last"))
    assert saved.progress.settings == {"recipe": "toy", "samples": [64, 128]}
    assert (saved.progress.step, saved.progress.planned_steps, saved.progress.micro_batches) == (
        12,
        20,
        3,
    )
    assert saved.progress.best == 1 / 3

    other = Toy(20)
    copied = adam(other)
    restore(saved, other, copied)
    assert all(torch.equal(other.state_dict()[k], v) for k, v in model.state_dict().items())
    for (_, a), (_, b) in zip(model.named_parameters(), other.named_parameters(), strict=True):
        assert (
            optimizer.state[a].keys() == copied.state[b].keys() == {"step", "exp_avg", "exp_avg_sq"}
        )
        for moment, value in optimizer.state[a].items():
            assert torch.equal(value, copied.state[b][moment])
            assert value.stride() == copied.state[b][moment].stride()


def test_a_part_under_two_names_is_saved_once(tmp_path: Path):
    model = Toy(20)
    model.again = model.net
    save_last(tmp_path, model, adam(model), TrainingProgress(0, 20, settings=SETTINGS))
    saved = load(file_of(tmp_path, "last"))
    assert not any("again" in name for name in saved.tensors)

    other = Toy(20)
    other.again = other.net
    with torch.no_grad():
        other.net[0].weight.zero_()
    restore(saved, other, adam(other))
    assert other.again[0].weight.equal(model.net[0].weight)


def test_training_goes_on_as_if_never_saved(tmp_path: Path, trained):
    save(tmp_path, trained, 12)
    model = Toy(20)
    optimizer = adam(model)
    restore(load(file_of(tmp_path, "last")), model, optimizer)
    fit(model, optimizer, steps=range(12, 20))
    fit(*trained, steps=range(12, 20))
    assert all(torch.equal(model.state_dict()[k], v) for k, v in trained[0].state_dict().items())


def test_a_parameter_that_has_not_moved_yet_has_no_moments(tmp_path: Path):
    model = Toy(20)
    optimizer = adam(model)
    fit(model, optimizer, steps=range(3))  # the grid joins in at step 10
    save(tmp_path, (model, optimizer), 3)
    other = Toy(20)
    restored = adam(other)
    restore(load(file_of(tmp_path, "last")), other, restored)
    assert other.grid not in restored.state
    fit(other, restored, steps=range(3, 13))
    fit(model, optimizer, steps=range(3, 13))
    assert torch.equal(model.grid, other.grid)


def test_the_same_state_has_the_same_bytes(tmp_path: Path, trained):
    save(tmp_path / "a", trained, 12)
    save(tmp_path / "b", trained, 12)
    first, second = (file_of(tmp_path / name, "last").read_bytes() for name in "ab")
    assert first == second


def test_it_is_plain_safetensors(tmp_path: Path, trained):
    save(tmp_path, trained, 12)
    tensors = load_file(file_of(tmp_path, "last"))
    assert torch.equal(tensors["model.grid"], trained[0].grid)


def test_the_one_before_is_kept(tmp_path: Path, trained):
    for step in (4, 8, 12):
        save(tmp_path, trained, step)
    assert load(file_of(tmp_path, "last")).progress.step == 12
    assert load(file_of(tmp_path, "previous")).progress.step == 8
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == [
        "last.safetensors",
        "previous.safetensors",
    ]


def test_the_best_holds_weights_alone(tmp_path: Path, trained):
    save_best(tmp_path, trained[0], TrainingProgress(12, 20, best=3.5))
    best = load(file_of(tmp_path, "best"))
    assert best.progress.best == 3.5
    assert all(name.startswith("model.") for name in best.tensors)
    other = Toy(20)
    restore_weights(best, other)
    assert torch.equal(other.grid, trained[0].grid)


def damage(path: Path, how: str) -> None:
    content = path.read_bytes()
    middle = len(content) // 2
    path.write_bytes(
        {
            "truncated": content[:middle],
            "empty": b"",
            "one bit": content[:-1] + bytes([content[-1] ^ 1]),
            "garbage": b"\xff" * len(content),
            "header": content.replace(b'\\"step\\":12', b'\\"step\\":13').replace(
                b'\\"step\\": 12', b'\\"step\\": 13'
            ),
        }[how]
    )
    assert path.read_bytes() != content


@pytest.mark.parametrize("how", ["truncated", "empty", "one bit", "garbage", "header"])
def test_a_damaged_checkpoint_is_noticed_and_the_one_before_used(tmp_path: Path, trained, how: str):
    for step in (8, 12):
        save(tmp_path, trained, step)
    last = file_of(tmp_path, "last")
    damage(last, how)
    with pytest.raises(RunError, match="cannot be read|is damaged") as error:
        load(last)
    assert str(last) in str(error.value)

    saved, warning = recover(tmp_path)
    assert saved is not None and saved.progress.step == 8
    assert warning.endswith("(last.safetensors): going back to step 8")
    # The good one stands in the place of the damaged one: the next save must not push it out.
    save(tmp_path, trained, 9)
    assert load(file_of(tmp_path, "previous")).progress.step == 8


def test_two_damaged_checkpoints_are_an_error(tmp_path: Path, trained):
    for step in (8, 12):
        save(tmp_path, trained, step)
    for name in ("last", "previous"):
        damage(file_of(tmp_path, name), "truncated")
    with pytest.raises(RunError, match="a checkpoint cannot be read"):
        recover(tmp_path)


def test_a_kill_between_the_two_moves_loses_nothing(tmp_path: Path, trained):
    for step in (8, 12):
        save(tmp_path, trained, step)
    file_of(tmp_path, "last").replace(file_of(tmp_path, "previous"))
    (tmp_path / "checkpoints" / ".last-x1.safetensors").write_bytes(b"half")
    saved, warning = recover(tmp_path)
    assert saved is not None and saved.progress.step == 12 and warning == ""
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["last.safetensors"]


def test_nothing_saved_is_nothing_to_recover(tmp_path: Path):
    assert recover(tmp_path) == (None, "")


def test_a_state_that_is_not_finite_overwrites_nothing(tmp_path: Path, trained):
    save(tmp_path, trained, 8)
    before = file_of(tmp_path, "last").read_bytes()
    with torch.no_grad():
        trained[0].grid[0, 0, 0, 0] = float("nan")
    with pytest.raises(RunError) as error:
        save(tmp_path, trained, 12)
    assert str(error.value).splitlines()[:3] == [
        "RunError: not saving a state that is not finite",
        "  where  step 12",
        "  got    model.grid",
    ]
    assert file_of(tmp_path, "last").read_bytes() == before
    assert len(list((tmp_path / "checkpoints").iterdir())) == 1


def test_another_model_is_refused(tmp_path: Path, trained):
    save(tmp_path, trained, 12)
    other = Toy(20)
    other.grid = nn.Parameter(torch.zeros(1, 3, 8, 5))
    other.extra = nn.Parameter(torch.zeros(1))
    with pytest.raises(RunError) as error:
        restore_weights(load(file_of(tmp_path, "last")), other)
    assert "got    extra, grid [1, 3, 4, 5] for [1, 3, 8, 5]" in str(error.value)


def test_other_settings_are_refused():
    check_settings({"a": 1, "b": [1, 2]}, {"a": 1, "b": (1, 2)})
    with pytest.raises(RunError) as error:
        check_settings({"rate": 0.1, "seed": 0}, {"rate": 0.2, "seed": 0, "new": 1})
    assert "got    new: None before, 1 now; rate: 0.1 before, 0.2 now" in str(error.value)
    nested = [{"options": {"steps": 9, "looks": {"early": early, "part": 0}}} for early in (0, 1)]
    with pytest.raises(RunError) as error:
        check_settings(*nested)
    assert "got    options.looks.early: 0 before, 1 now\n" in str(error.value)


def test_nothing_loaded_is_unpickled(tmp_path: Path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    trap = tmp_path / "trap.safetensors"
    trap.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(RunError):
        load(trap)
    torch.save({"trap": torch.zeros(1)}, trap)
    with pytest.raises(RunError):
        load(trap)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    "header", [None, "not json", json.dumps({"progress": {}}), json.dumps(["checksum"])]
)
def test_someone_elses_safetensors_are_refused(tmp_path: Path, header: str | None):
    path = tmp_path / "other.safetensors"
    save_file(
        {"a": torch.zeros(2)}, path, metadata=None if header is None else {"sharpfield": header}
    )
    with pytest.raises(RunError, match="not a checkpoint of sharpfield"):
        load(path)


def test_a_missing_checkpoint_is_named(tmp_path: Path):
    with pytest.raises(RunError, match="there is no such checkpoint\n  where  .*best.safetensors"):
        load(file_of(tmp_path, "best"))
