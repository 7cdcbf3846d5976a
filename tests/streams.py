"""Streams of events to test on."""

import numpy as np

from sharpfield.core import EventStream

WIDTH, HEIGHT = 12, 10


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
