"""Fixtures of all tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure, Frames
from sharpfield.geometry.trajectory import Stamped
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from tests.streams import HEIGHT, WIDTH, random_events

SAMPLES = Path(__file__).parents[1].parent / "shared" / "data"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of our own."""
    parser.addoption("--golden", action="store_true", help="compute all golden numbers")


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


FRAMES = 9


def turning(times_us: np.ndarray) -> np.ndarray:
    """Poses of a camera that pans and slides, 4 per mille of a turn in 10 ms."""
    angle = times_us / 4e5
    zero, one = np.zeros_like(angle), np.ones_like(angle)
    rotation = np.stack(
        [np.cos(angle), zero, np.sin(angle), zero, one, zero, -np.sin(angle), zero, np.cos(angle)],
        -1,
    ).reshape(-1, 3, 3)
    centre = np.stack([angle, 0.5 * angle**2, -angle], -1)
    return np.concatenate([rotation, centre[:, :, None]], -1)


@pytest.fixture
def panning() -> Capture:
    """Nine frames, the first and the ninth sharp and held out, on one moving track."""
    draw = np.random.default_rng(1)
    clock = Clock(0, 100_000)
    stamps = np.arange(0, 100_001, 5_000)
    opens = 2_000 + np.arange(FRAMES) * 10_000
    closes = opens + 8_000
    opens[[0, 8]] = closes[[0, 8]] = [6_000, 86_000]
    images = draw.integers(0, 256, (FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    return Capture(
        camera=Camera(WIDTH, HEIGHT, 11.0, 11.0, WIDTH / 2, HEIGHT / 2),
        trajectory=Stamped(stamps, turning(stamps), clock),
        clock=clock,
        near=0.7,
        far=9.1,
        frames=Frames(
            images,
            Exposure(opens, closes),
            np.zeros(FRAMES, np.int64),
            tuple(f"{i:02d}" for i in range(FRAMES)),
        ),
        events=random_events(5_000),
        split=Split(np.arange(1, 8), np.array([0, 8])),
        name="panning",
    )


@pytest.fixture(scope="session")
def tiny() -> Capture:
    """16x16 pixels, six frames of which two are held out."""
    timing = Timing(frames=6, exposure_us=20_000, interval_us=24_000, test_every=4)
    return simulate("tiles", rig=Rig(size=(16, 16)), timing=timing, seed=3)
