from collections.abc import Callable

import numpy as np
import pytest

from sharpfield.core import Camera, Capture, Clock, EventStream, Exposure, Frames, Split
from sharpfield.geometry.trajectory import Stamped

WIDTH, HEIGHT, FRAMES = 12, 10, 9


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


def random_events(count: int, *, last_us: int = 90_000, seed: int = 0) -> EventStream:
    draw = np.random.default_rng(seed)
    return EventStream(
        x=draw.integers(0, WIDTH, count).astype(np.uint16),
        y=draw.integers(0, HEIGHT, count).astype(np.uint16),
        t_us=np.sort(draw.integers(1_000, last_us, count)),
        p=draw.choice(np.array([-1, 1], np.int8), count),
        width=WIDTH,
        height=HEIGHT,
    )


@pytest.fixture
def some_events() -> Callable[..., EventStream]:
    return random_events


@pytest.fixture
def tiny() -> Capture:
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
        name="tiny",
    )
