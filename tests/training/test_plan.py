import pytest
import torch

from sharpfield.core.errors import OptionError
from sharpfield.training.options import TrainingOptions
from sharpfield.training.plan import TIME_FRACTION, Plan, affordable_steps, make_plan
from tests.training.toy import Toy


def test_the_recipe_gives_the_length_unless_told_otherwise():
    plan, model = make_plan(Toy, TrainingOptions(), steps=30, seconds=float("inf"))
    assert plan == Plan(30, 1) and model.steps == 30
    plan, model = make_plan(Toy, TrainingOptions(steps=12), steps=30, seconds=float("inf"))
    assert plan == Plan(12, 1) and model.steps == 12


def test_minutes_are_filled_with_steps():
    # A step takes 10 ms and a little; 1 s of them, of which the trials take five.
    toy = Toy(100, seconds_per_step=0.01)
    affordable_steps(
        toy, seconds=0.0, schedule=100, micro_batches=1
    )  # what only a first step costs
    steps = affordable_steps(toy, seconds=1.0, schedule=100, micro_batches=1)
    assert 10 <= steps <= TIME_FRACTION * 95


def test_the_schedule_is_made_for_the_steps_that_fit():
    built = []

    def build(steps: int) -> Toy:
        built.append(Toy(steps, seconds_per_step=0.005))
        return built[-1]

    plan, model = make_plan(build, TrainingOptions(minutes=0.01), steps=10_000, seconds=0.6)
    assert [toy.steps for toy in built] == [10_000, plan.steps] and plan.steps < 120
    assert model is built[1]
    fresh = Toy(plan.steps)
    assert all(torch.equal(fresh.state_dict()[k], v) for k, v in model.state_dict().items())


def test_no_time_is_still_one_step():
    assert affordable_steps(Toy(10), seconds=0.0, schedule=10, micro_batches=1) == 1


def test_a_small_budget_splits_the_batch():
    wide = lambda steps: Toy(steps, measurements=4096)  # noqa: E731
    plan, _ = make_plan(wide, TrainingOptions(memory_gb=0.0004), steps=5, seconds=0.0)
    assert plan.micro_batches > 1 and 4096 % plan.micro_batches == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 5, "minutes": 1.0}, "`steps` and `minutes` exclude each other"),
        ({"steps": 0}, "`steps` must be positive\n  got    0"),
        ({"minutes": -1.0}, "`minutes` must be positive\n  got    -1.0"),
        ({"memory_gb": float("nan")}, "`memory_gb` must be positive\n  got    nan"),
        ({"checkpoint_every": 0}, "`checkpoint_every` must be positive"),
        ({"log_every": 0}, "`log_every` must be positive"),
    ],
)
def test_senseless_options_are_refused(options: dict, message: str):
    with pytest.raises(OptionError) as error:
        TrainingOptions(**options)
    assert message in str(error.value)
