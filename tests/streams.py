"""Streams of events to test on."""

import numpy as np

from sharpfield.core.events import EventStream

WIDTH, HEIGHT = 12, 10


def random_events(
    count: int,
    *,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    first_us: int = 1_000,
    last_us: int = 90_000,
    bayer: str = "",
    seed: int = 0,
) -> EventStream:
    draw = np.random.default_rng(seed)
    return EventStream(
        x=draw.integers(0, size[0], count).astype(np.uint16),
        y=draw.integers(0, size[1], count).astype(np.uint16),
        t_us=np.sort(draw.integers(first_us, last_us, count)),
        p=draw.choice(np.array([-1, 1], np.int8), count),
        width=size[0],
        height=size[1],
        bayer=bayer,
    )
