from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from sharpfield.core import EventStream
from tests.streams import random_events

SAMPLES = Path(__file__).parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """The tensors of tests are tiny: more threads would only wait for each other."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def samples() -> Path:
    """Real recordings beside the checkout. They are not part of the project: skip without them."""
    if not SAMPLES.is_dir():
        pytest.skip("no sample recordings in ../shared/data beside the checkout")
    return SAMPLES


@pytest.fixture
def some_events() -> Callable[..., EventStream]:
    """Makes random streams of a tiny sensor."""
    return random_events
