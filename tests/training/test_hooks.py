import pytest
import torch

from sharpfield.core.errors import RunError
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from sharpfield.training.session import describe, every, every_seconds, require_finite
from tests.training.toy import Toy


def called_at(wrap, steps: range) -> list[int]:
    calls, model = [], Toy(1)
    hook = wrap(lambda step, *rest: calls.append(step))
    for step in steps:
        hook(step, model, adam(model), {})
    return calls


def test_every_counts_finished_steps_wherever_a_session_begins():
    assert called_at(lambda hook: every(4, hook), range(12)) == [3, 7, 11]
    assert called_at(lambda hook: every(4, hook), range(6, 12)) == [7, 11]
    assert called_at(lambda hook: every(1, hook), range(3)) == [0, 1, 2]


def test_every_may_include_the_last_step():
    assert called_at(lambda hook: every(4, hook, last=10), range(10)) == [3, 7, 9]
    assert called_at(lambda hook: every(5, hook, last=10), range(10)) == [4, 9]


def test_every_so_many_seconds():
    times = iter([0.0, 3.0, 11.0, 12.0, 20.0, 21.9, 22.0, 22.0])
    wrapped = called_at(lambda hook: every_seconds(10.0, hook, clock=lambda: next(times)), range(5))
    assert wrapped == [1, 4]


def test_finite_losses_pass():
    model = Toy(1)
    require_finite(3, model, adam(model), {"a": torch.tensor(1e30), "b": torch.tensor(-2.0)})


@pytest.mark.parametrize("ill", ["nan", "inf", "-inf"])
def test_a_loss_that_is_not_finite_is_named_with_step_and_batch(ill: str):
    losses = {"blur": torch.tensor(0.25), "events": torch.tensor(float(ill))}
    model = Toy(1, measurements=3)
    with pytest.raises(RunError) as error:
        require_finite(41, model, adam(model), losses)
    what, where, got, do = str(error.value).splitlines()
    assert what == "RunError: the loss 'events' is not finite"
    assert where.startswith("  where  step 41; batch: frames (3 Pixels): xy 0.")
    assert got == f"  got    blur 0.25, events {ill}"
    assert do.startswith("  do     lower the learning rate, or look for odd values")


def test_a_batch_with_odd_values_says_so():
    batch = Toy(1, measurements=2).draw(0)
    batch["frames"].value[0] = float("nan")
    batch["frames"].value[1] = 0.5
    assert "value 0.5...0.5 and 3 not finite" in describe(batch)
    assert "frame 0...0, track 0...0" in describe(batch)
    assert "value empty" in describe({"frames": batch["frames"][:0]})


def test_the_guard_ends_training_at_the_step():
    model = Toy(20)
    model.losses = lambda batch, step: {
        "odd": model.net[0].weight.sum() * (float("inf") if step == 2 else 1.0)
    }
    with pytest.raises(RunError, match="step 2; batch"):
        fit(model, adam(model), steps=range(9), hooks=[require_finite])
