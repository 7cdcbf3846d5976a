from pathlib import Path

import pytest
import torch
from torch import nn

from sharpfield.core.errors import RunError
from sharpfield.core.protocols import Growing, Growth, PointSet, unchanged
from sharpfield.training.checkpoint import (
    TrainingProgress,
    file_of,
    load,
    restore,
    restore_weights,
    save_last,
)
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam, apply_growth, resize
from sharpfield.training.options import TrainingOptions
from sharpfield.training.session import train
from tests.training.growing import Blobs, GrowingToy
from tests.training.toy import Toy, quiet


def pulled_twice(blobs: Blobs) -> torch.optim.Adam:
    """Two steps of an optimizer, so that it has moments."""
    optimizer = torch.optim.Adam(blobs.parameters(), lr=0.1)
    for _ in range(2):
        optimizer.zero_grad()
        blobs(torch.rand(9, 2)).square().sum().backward()
        optimizer.step()
    return optimizer


def moments(optimizer: torch.optim.Adam, parameter: nn.Parameter) -> tuple:
    state = optimizer.state[parameter]
    return state["exp_avg"], state["exp_avg_sq"], state["step"]


def test_rows_and_their_moments_go_together():
    blobs = Blobs(4)
    optimizer = pulled_twice(blobs)
    old = {name: rows.detach().clone() for name, rows in blobs.points().items()}
    before = [m.clone() for m in moments(optimizer, blobs.places)]
    source, fresh = torch.tensor([3, 1, 1]), torch.tensor([False, False, True])
    apply_growth(blobs, optimizer, Growth(source, fresh))
    assert all(torch.equal(rows, old[name][source]) for name, rows in blobs.points().items())
    first, second, steps = moments(optimizer, blobs.places)
    for now, then in ((first, before[0]), (second, before[1])):
        assert torch.equal(now[:2], then[[3, 1]]) and not now[2].any()
        assert then[[3, 1]].all()
    assert steps == before[2] == 2


def test_a_value_that_was_set_loses_its_moments_and_no_other_does():
    blobs = Blobs(4)
    optimizer = pulled_twice(blobs)
    before = moments(optimizer, blobs.places)[0].clone()
    places = blobs.places.detach().clone()
    places[2, 0] = 9.0
    growth = unchanged(4)
    growth.values["places"] = places
    apply_growth(blobs, optimizer, growth)
    assert torch.equal(blobs.places, places)
    first = moments(optimizer, blobs.places)[0]
    assert first[2, 0] == 0 and before[2, 0] != 0
    first[2, 0] = before[2, 0]
    assert torch.equal(first, before)
    assert moments(optimizer, blobs.colours)[0].all()


def test_the_optimizer_goes_on_with_the_new_parameters():
    blobs = Blobs(4)
    optimizer = pulled_twice(blobs)
    old = list(blobs.parameters())
    apply_growth(blobs, optimizer, Growth(torch.arange(3), torch.zeros(3, dtype=torch.bool)))
    assert [id(p) for p in optimizer.param_groups[0]["params"]] == [
        id(p) for p in blobs.parameters()
    ]
    assert not any(parameter in optimizer.state for parameter in old)
    before = blobs.places.detach().clone()
    blobs(torch.rand(9, 2)).sum().backward()
    optimizer.step()
    assert not torch.equal(blobs.places, before)


def test_points_learn_alike_whether_others_were_dropped_or_never_there():
    """Pruning is invisible to those that stay: oracle for rows, moments and step counts."""

    def trained(keep: torch.Tensor, *, prune: bool) -> torch.Tensor:
        rows = torch.linspace(0, 1, 8)[:, None].repeat(1, 2)
        blobs = Blobs(8)
        blobs.replace({"places": rows if prune else rows[keep]})
        optimizer = torch.optim.Adam([blobs.places], lr=0.1)
        for step in range(6):
            optimizer.zero_grad()
            ((blobs.places - 0.3) ** 3).sum().backward()
            optimizer.step()
            if prune and step == 2:
                apply_growth(
                    blobs, optimizer, Growth(keep, torch.zeros(len(keep), dtype=torch.bool))
                )
        return blobs.places.detach()

    keep = torch.tensor([0, 3, 4, 7])
    assert torch.equal(trained(keep, prune=True), trained(keep, prune=False))


def test_before_the_first_step_there_are_no_moments():
    blobs = Blobs(4)
    optimizer = torch.optim.Adam(blobs.parameters())
    apply_growth(blobs, optimizer, Growth(torch.arange(2), torch.ones(2, dtype=torch.bool)))
    assert not optimizer.state and len(blobs.places) == 2


def test_all_may_go():
    blobs = Blobs(4)
    optimizer = pulled_twice(blobs)
    none = torch.zeros(0, dtype=torch.int64)
    apply_growth(blobs, optimizer, Growth(none, none.bool()))
    assert blobs.places.shape == (0, 2)
    blobs(torch.rand(9, 2)).sum().backward()
    optimizer.step()


def test_resizing_makes_room():
    blobs = Blobs(4)
    resize(blobs, 7)
    assert blobs.places.shape == (7, 2) and blobs.pulled.shape == (7,)
    assert isinstance(blobs.places, nn.Parameter)


def test_the_loop_lets_points_grow():
    model = GrowingToy(20)
    assert isinstance(model, Growing) and isinstance(model.blobs, PointSet)
    seen = []
    fit(
        model,
        adam(model),
        steps=range(9),
        hooks=[lambda step, model, optimizer, _: seen.append(len(model.blobs.places))],
    )
    assert seen == [6, 6, 6, 7, 7, 7, 7, 8, 8]


def test_resuming_equals_never_having_stopped_also_for_points_that_grew(tmp_path: Path):
    def run(folder: str, steps: range, saved: str | None = None) -> bytes:
        model = GrowingToy(20)
        optimizer = adam(model)
        if saved is not None:
            restore(load(file_of(tmp_path / saved, "last")), model, optimizer)
        fit(model, optimizer, steps=steps)
        save_last(tmp_path / folder, model, optimizer, TrainingProgress(steps.stop, 20))
        return file_of(tmp_path / folder, "last").read_bytes()

    straight = run("straight", range(18))
    for stop in (3, 4, 10, 17):
        run(f"until {stop}", range(stop))
        assert run(f"from {stop}", range(stop, 18), saved=f"until {stop}") == straight


def test_a_whole_run_resumes_alike(tmp_path: Path):
    def go(folder: str, build, *, resume: bool) -> None:
        options = TrainingOptions(checkpoint_every=5, resume=resume)
        train(build, tmp_path / folder, options, steps=18, settings={}, console=quiet())

    class Dying(GrowingToy):
        def draw(self, step: int):
            if step == 13:
                raise KeyboardInterrupt
            return super().draw(step)

    go("straight", GrowingToy, resume=False)
    with pytest.raises(KeyboardInterrupt):
        go("stopped", Dying, resume=False)
    go("stopped", GrowingToy, resume=True)
    straight, stopped = (file_of(tmp_path / name, "last") for name in ("straight", "stopped"))
    assert straight.read_bytes() == stopped.read_bytes()


def test_weights_alone_bring_their_number_of_points(tmp_path: Path):
    model = GrowingToy(20)
    optimizer = adam(model)
    fit(model, optimizer, steps=range(12))
    save_last(tmp_path, model, optimizer, TrainingProgress(12, 20))
    other = GrowingToy(20)
    restore_weights(load(file_of(tmp_path, "last")), other)
    assert torch.equal(other.blobs.places, model.blobs.places) and len(other.blobs.places) == 9


def test_another_models_checkpoint_is_still_refused(tmp_path: Path):
    model = Toy(20)
    save_last(tmp_path, model, adam(model), TrainingProgress(0, 20))
    with pytest.raises(RunError, match="belongs to another model"):
        restore_weights(load(file_of(tmp_path, "last")), GrowingToy(20))


def test_unknown_names_are_noticed():
    blobs = Blobs(2)
    growth = unchanged(2)
    growth.values["sizes"] = torch.zeros(2)
    with pytest.raises(AssertionError, match="no points named {'sizes'}"):
        apply_growth(blobs, torch.optim.Adam(blobs.parameters()), growth)
