"""Mistakes of the writer of a recording, undone: axes exchanged or mirrored, signs flipped.

`sharpfield doctor` finds them by comparing events with frames.
"""

from dataclasses import dataclass, replace

import numpy as np

from sharpfield.core.events import EventStream
from sharpfield.recordings.recording import Chunks, Recording


@dataclass(frozen=True)
class Mistakes:
    """What is wrong with the events of a recording."""

    swap_xy: bool = False
    """Columns and rows are exchanged."""
    flip_x: bool = False
    """Columns count from the right, after any exchange."""
    flip_y: bool = False
    """Rows count from the bottom."""
    flip_polarity: bool = False
    """Brighter is said to be darker."""

    def __str__(self) -> str:
        """In words; nothing if nothing is wrong."""
        words = {
            "x and y exchanged": self.swap_xy,
            "x mirrored": self.flip_x,
            "y mirrored": self.flip_y,
            "polarity flipped": self.flip_polarity,
        }
        return ", ".join(word for word, wrong in words.items() if wrong)


def mended(recording: Recording, mistakes: Mistakes) -> Recording:
    """The same recording without the mistakes; its frames are as they were.

    The size of a recording whose axes are exchanged is taken to be exchanged as well.
    """
    if not str(mistakes) or recording.events is None:
        return recording
    opened, size = recording.events, recording.size
    if size is not None and mistakes.swap_xy:
        size = size[::-1]

    def events() -> Chunks:
        return (_mended(chunk, mistakes) for chunk in opened())

    layout = f"{recording.layout} ({mistakes})"
    return replace(recording, events=events, size=size, layout=layout)


def _mended(events: EventStream, mistakes: Mistakes) -> EventStream:
    x, y, width, height = events.x, events.y, events.width, events.height
    if mistakes.swap_xy:
        x, y, width, height = y, x, height, width
    if mistakes.flip_x:
        x = (width - 1 - x).astype(x.dtype)
    if mistakes.flip_y:
        y = (height - 1 - y).astype(y.dtype)
    p = (-events.p).astype(np.int8) if mistakes.flip_polarity else events.p
    return replace(events, x=x, y=y, p=p, width=width, height=height)
