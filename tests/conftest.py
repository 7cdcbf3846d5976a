from pathlib import Path

import pytest
import torch

SAMPLES = Path(__file__).parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def two_threads() -> None:
    """The tests measure themselves on two cores, wherever they run."""
    torch.set_num_threads(min(2, torch.get_num_threads()))


@pytest.fixture(scope="session")
def samples() -> Path:
    """Real recordings beside the checkout. They are not part of the project: skip without them."""
    if not SAMPLES.is_dir():
        pytest.skip("no sample recordings in ../shared/data beside the checkout")
    return SAMPLES
