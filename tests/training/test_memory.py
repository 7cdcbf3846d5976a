import pytest
import torch
from torch import nn

from sharpfield.core.errors import OptionError
from sharpfield.training import memory
from sharpfield.training.memory import accumulate, plan_micro_batches, saved_bytes, split_batch
from tests.training.toy import Toy


class Squares(Toy):
    """Keeps `width` floats per measurement for the backward pass, and `always` more."""

    heaviest_step = 7

    def __init__(self, *, measurements: int = 64, width: int = 1000, always: int = 0):
        nn.Module.__init__(self)
        self.weight = nn.Parameter(torch.ones(width))
        self.always = torch.ones(always)
        self.measurements = measurements
        self.asked = set()

    def draw(self, step):
        self.asked.add(step)
        return super().draw(step)

    def losses(self, batch, step):
        wide = batch["frames"].xy[:, :1] + self.weight
        return {
            "squares": wide.square().mean(),
            "always": (self.weight[0] * self.always).square().sum(),
        }


def gradients(model, micro_batches, step=12):
    model.zero_grad()
    losses = accumulate(model, model.draw(step), step, micro_batches=micro_batches)
    return losses, [parameter.grad.clone() for parameter in model.parameters()]


@pytest.mark.parametrize("micro_batches", [2, 3, 5, 48])
def test_gradients_and_losses_of_parts_add_up_to_those_of_the_whole(micro_batches):
    model = Toy(20)
    whole, straight = gradients(model, 1)
    sums, pieced = gradients(model, micro_batches)
    torch.testing.assert_close(sums, whole)
    torch.testing.assert_close(pieced, straight, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("micro_batches", [1, 2, 7, 48])
def test_parts_cover_the_batch_once(micro_batches):
    batch = Toy(20).draw(0)
    pieces = list(split_batch(batch, micro_batches))
    assert sum(share for _, share in pieces) == pytest.approx(1)
    joined = torch.cat([piece["frames"].value for piece, _ in pieces])
    assert torch.equal(joined, batch["frames"].value)


def test_kept_bytes_match_a_count_by_hand():
    model = Squares(width=1000, always=300)
    # [64, 1000] floats for the first square; the constant and its multiple for the other product.
    by_hand = 4 * (64 * 1000 + 300 + 300)
    assert saved_bytes(model, model.draw(0), 0) == by_hand


def test_kept_bytes_count_shared_memory_once_and_parameters_never():
    model = Squares(width=1000)
    model.losses = lambda batch, step: {"own": (model.weight.square() + model.weight.sin()).sum()}
    assert saved_bytes(model, model.draw(0), 0) == 0
    value = torch.ones(500)
    model.losses = lambda batch, step: {
        name: (model.weight[:500] * value).sum() for name in ("first", "second")
    }
    assert saved_bytes(model, model.draw(0), 0) == 500 * 4


def test_a_generous_budget_needs_one_part():
    assert plan_micro_batches(Squares(), budget_bytes=10**9) == 1


def test_the_heaviest_step_is_asked():
    model = Squares()
    plan_micro_batches(model, budget_bytes=10**9)
    assert model.asked == {7}


@pytest.mark.parametrize("shrink", [2, 3, 5, 11, 30])
def test_a_part_keeps_what_the_budget_allows(shrink):
    model = Squares(always=500)
    parameters = memory.COPIES * model.weight.nbytes
    budget = int(memory.PEAK_FACTOR * saved_bytes(model, model.draw(7), 7) / shrink) + parameters
    micro_batches = plan_micro_batches(model, budget_bytes=budget)
    largest = max(
        saved_bytes(model, part, 7) for part, _ in split_batch(model.draw(7), micro_batches)
    )
    assert parameters + memory.PEAK_FACTOR * largest <= budget * 1.02
    assert micro_batches <= 2.2 * shrink


def test_parts_divide_the_batch_evenly_where_they_can():
    model = Squares(measurements=1024)
    kept = memory.PEAK_FACTOR * saved_bytes(model, model.draw(7), 7)
    budget = int(kept / 3) + memory.COPIES * model.weight.nbytes
    assert plan_micro_batches(model, budget_bytes=budget) == 4


def test_planning_changes_no_parameter_and_leaves_no_gradient():
    model = Squares()
    plan_micro_batches(model, budget_bytes=10**9)
    assert torch.equal(model.weight, torch.ones(1000)) and model.weight.grad is None


def test_what_cannot_fit_is_refused():
    with pytest.raises(OptionError) as error:
        plan_micro_batches(Squares(), budget_bytes=1000)
    assert str(error.value).splitlines() == [
        "OptionError: one training step does not fit in the memory budget, however it is split",
        "  got    a budget of 0.00 GiB, at least 0.00 GiB needed",
        "  do     raise `memory_gb` (--memory-gb), or choose a smaller preset",
    ]


def test_the_machine_knows_its_memory():
    cpu = torch.device("cpu")
    assert memory.available_bytes(cpu) > 2**20
    before = memory.peak_memory_mb(cpu)
    torch.ones(2**24)
    assert memory.peak_memory_mb(cpu) >= before > 10
