import itertools

import torch

from sharpfield.training.loop import fit
from sharpfield.training.optim import adam
from tests.training.toy import Toy


def trained(steps: range, *, micro_batches: int = 1) -> Toy:
    model = Toy(20)
    fit(model, adam(model), steps=steps, micro_batches=micro_batches)
    return model


def test_training_lowers_the_loss():
    model, seen = Toy(100), []
    fit(model, adam(model), steps=range(100), hooks=[lambda *step: seen.append(step[3]["colour"])])
    assert seen[-1] < 0.2 * seen[0]


def test_training_is_a_function_of_its_steps():
    first, second = trained(range(15)).state_dict(), trained(range(15)).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_two_calls_equal_one():
    model = Toy(20)
    optimizer = adam(model)
    fit(model, optimizer, steps=range(7))
    fit(model, optimizer, steps=range(7, 15))
    straight = trained(range(15)).state_dict()
    assert all(torch.equal(straight[name], value) for name, value in model.state_dict().items())


def test_parts_train_as_the_whole_does():
    whole, micro_batches = trained(range(12)), trained(range(12), micro_batches=4)
    for a, b in zip(whole.parameters(), micro_batches.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def test_hooks_follow_each_step_in_order():
    calls, model = [], Toy(20)
    hooks = [
        lambda step, *rest: calls.append(("first", step)),
        lambda step, *rest: calls.append(("second", step)),
    ]
    fit(model, adam(model), steps=range(3, 5), hooks=hooks)
    assert calls == [("first", 3), ("second", 3), ("first", 4), ("second", 4)]


def test_losses_reach_hooks_detached():
    seen, model = [], Toy(20)
    fit(model, adam(model), steps=[10], hooks=[lambda *step: seen.append(step[3])])
    assert seen[0].keys() == {"colour", "grid"}
    assert not any(loss.requires_grad for loss in seen[0].values())


def test_steps_may_end_early():
    calls, model = [], Toy(20)
    fit(
        model,
        adam(model),
        steps=itertools.takewhile(lambda _: len(calls) < 3, range(100)),
        hooks=[lambda step, *rest: calls.append(step)],
    )
    assert calls == [0, 1, 2]


def test_no_steps_change_nothing():
    model = Toy(20)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fit(model, adam(model), steps=range(0))
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
