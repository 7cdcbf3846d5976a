"""Small recordings to be written and read back."""

from pathlib import Path

import numpy as np

from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Frame, Recording, Triggers
from tests.streams import HEIGHT, WIDTH, random_events

START_US = 1_589_163_147_000_000


def some_frames(count: int = 4, *, colours: tuple[int, ...] = (), kind: type = np.uint8) -> list:
    draw = np.random.default_rng(1)
    limit = np.iinfo(kind).max
    return [
        Frame(
            draw.integers(0, limit, (HEIGHT, WIDTH, *colours), dtype=kind, endpoint=True),
            START_US + 20_000 * i,
            START_US + 20_000 * i + 7_000 + i,
        )
        for i in range(count)
    ]


def some_recording(count: int = 3000, frames: list[Frame] | None = None) -> Recording:
    """Events, frames and triggers of a tiny camera, on a clock that counts from 1970."""
    since = random_events(count)
    events = EventStream(since.x, since.y, since.t_us + START_US, since.p, WIDTH, HEIGHT)
    shots = some_frames() if frames is None else frames
    edges = Triggers(
        START_US + np.array([5, 900, 30_000]),
        np.array([1, -1, 1], np.int8),
        np.array([0, 0, 1], np.uint8),
    )
    return Recording(
        Path("camera"),
        "simulated",
        (WIDTH, HEIGHT),
        events=lambda: iter([events[:1000], events[1000:]]),
        frames=lambda: iter(shots),
        triggers=lambda: edges,
    )


def expect_equal_events(got: EventStream, expected: EventStream) -> None:
    assert (got.width, got.height) == (expected.width, expected.height)
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), err_msg=name)


def expect_equal_frames(got: list[Frame], expected: list[Frame]) -> None:
    assert len(got) == len(expected)
    for one, other in zip(got, expected, strict=True):
        assert one.image.dtype == other.image.dtype
        np.testing.assert_array_equal(one.image, other.image)
        assert (one.open_us, one.close_us) == (other.open_us, other.close_us)
