import pytest
import torch

from sharpfield.core.schedule import Group, linear
from sharpfield.training.loop import fit
from sharpfield.training.optim import adam, set_rates
from tests.training.toy import Toy


def slow_adam(model: Toy, steps: int) -> None:
    """Algorithm 1 of Kingma and Ba (2015), in float64, one number of the schedule at a time."""
    moments = {}
    for step in range(steps):
        model.zero_grad()
        sum(model.losses(model.draw(step), step).values()).backward()
        for group in model.groups():
            for parameter in group.parameters:
                if parameter.grad is None:
                    continue
                gradient = parameter.grad.double()
                first, second, count = moments.get(parameter, (0, 0, 0))
                first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 1e-3 * gradient**2
                moments[parameter] = first, second, count = first, second, count + 1
                ahead = (first / (1 - 0.9**count)) / ((second / (1 - 0.999**count)).sqrt() + 1e-8)
                parameter.data -= (group.rate(step) * ahead).float()


def test_matches_the_algorithm_as_published():
    ours, slow = Toy(20), Toy(20)
    fit(ours, adam(ours), steps=range(16))
    slow_adam(slow, 16)
    for a, b in zip(ours.parameters(), slow.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_rates_follow_their_schedules():
    model = Toy(20)
    optimizer = adam(model)
    groups = [
        Group("net", (), linear(1.0, 0.0, begin=0, until=10)),
        Group("grid", (), linear(0.0, 4.0, begin=5, until=10)),
    ]
    for step, rates in [(0, (1.0, 0.0)), (5, (0.5, 0.0)), (10, (0.0, 4.0))]:
        set_rates(optimizer, groups, step)
        assert tuple(group["lr"] for group in optimizer.param_groups) == pytest.approx(rates)


def test_updates_are_fused():
    assert adam(Toy(20)).defaults["fused"]


def test_groups_without_parameters_are_left_out():
    model = Toy(20)
    groups = model.groups()
    model.groups = lambda: [*groups, Group("nothing", (), lambda step: 1.0)]
    fit(model, adam(model), steps=range(2))


def test_a_forgotten_parameter_is_found():
    model = Toy(20)
    groups = model.groups()
    model.groups = lambda: groups[:1]
    with pytest.raises(AssertionError, match="parameters of no group: grid"):
        adam(model)
    model.grid.requires_grad_(False)
    assert len(adam(model).param_groups) == 1
