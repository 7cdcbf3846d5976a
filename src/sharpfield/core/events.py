"""What an event camera reports: where and when brightness changed by a threshold, and its sign.

Integer coordinates name a pixel of the sensor (its centre is at +0.5). Float coordinates are
rectified positions *in the same index units*: 10.0 means the centre of ideal pixel 10.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int8, Int64, Shaped

from sharpfield.core.errors import CaptureError


@dataclass(frozen=True)
class EventStream:
    """Events of one sensor in the order of time. Arrays may be memory-mapped.

    Making one checks nothing, so that slices cost nothing; readers call `checked`.
    """

    x: Shaped[np.ndarray, "n"]
    """Column: int16/uint16 of the sensor, or float32 if rectified."""
    y: Shaped[np.ndarray, "n"]
    t_us: Int64[np.ndarray, "n"]
    p: Int8[np.ndarray, "n"]
    """-1 darker, +1 brighter."""
    width: int
    height: int
    bayer: str = ""
    """Colour filter tile of the raw sensor, e.g. "RGGB" for integer coordinates; "" if mono."""
    site_colour: "SiteColour | None" = None
    """Colour of rectified positions, where coordinates are floats on a colour sensor."""

    def __len__(self) -> int:
        """Number of events."""
        return len(self.t_us)

    @property
    def rectified(self) -> bool:
        """Whether coordinates are rectified positions (floats) instead of sensor pixels."""
        return np.issubdtype(self.x.dtype, np.floating)

    @property
    def coloured(self) -> bool:
        """Whether each event comes from behind a known colour filter."""
        return bool(self.bayer) or self.site_colour is not None

    def window(self, start_us: int, end_us: int) -> "EventStream":
        """Events with start <= t < end, as views."""
        first, last = np.searchsorted(self.t_us, [start_us, end_us], side="left")
        return self[int(first) : int(last)]

    def __getitem__(self, part: slice) -> "EventStream":
        """A slice of the stream, as views."""
        return replace(self, x=self.x[part], y=self.y[part], t_us=self.t_us[part], p=self.p[part])


@dataclass(frozen=True)
class SiteColour:
    """Which colour filter lies before each rectified position: 0 red, 1 green, 2 blue."""

    x: Shaped[np.ndarray, "m"]
    y: Shaped[np.ndarray, "m"]
    channel: Int8[np.ndarray, "m"]


def checked(events: EventStream, where: object) -> EventStream:
    """The same stream, once it is known to be sound.

    Args:
        events: A whole stream, in memory (a reader of larger ones calls this for each chunk).
        where: The file, for the message.

    Raises:
        CaptureError: Counts differ, times are not ascending, a coordinate is not finite or lies
            outside the sensor, or a polarity is neither -1 nor +1.
    """
    counts = {len(events.x), len(events.y), len(events.t_us), len(events.p)}
    if len(counts) != 1:
        raise CaptureError(
            "event columns have different lengths",
            where=where,
            got=f"x {len(events.x)}, y {len(events.y)}, t {len(events.t_us)}, p {len(events.p)}",
            do="the file may be truncated: copy or convert it again",
        )
    if not len(events):
        return events
    back = np.flatnonzero(np.diff(events.t_us) < 0)
    if len(back):
        i = int(back[0])
        raise CaptureError(
            "event times are not ascending",
            where=where,
            got=f"event {i} at {events.t_us[i]} us, event {i + 1} at {events.t_us[i + 1]} us"
            f" ({len(back)} steps back in all)",
            do="sort the events by time (stable), and check that clock wraps were undone",
        )
    for name, values, size in (("x", events.x, events.width), ("y", events.y, events.height)):
        _inside(name, values, size, rectified=events.rectified, where=where)
    wrong = np.flatnonzero(np.abs(events.p) != 1)
    if len(wrong):
        raise CaptureError(
            "polarity must be -1 or +1",
            where=f"{where}, event {wrong[0]}",
            got=events.p[wrong[0]],
            do="map 0 to -1 when reading",
        )
    return events


def _inside(
    name: str, values: Shaped[np.ndarray, "n"], size: int, *, rectified: bool, where: object
) -> None:
    if rectified and not np.isfinite(values).all():
        i = int(np.flatnonzero(~np.isfinite(values))[0])
        raise CaptureError(
            f"event coordinate {name} is not a finite number",
            where=f"{where}, event {i}",
            got=values[i],
            do="drop these events when converting",
        )
    # Rectified positions of border pixels may lie somewhat outside the ideal image.
    margin = size if rectified else 0
    low, high = float(values.min()), float(values.max())
    if low < -margin or high > size - 1 + margin:
        raise CaptureError(
            "events lie outside the sensor",
            where=where,
            got=f"{name} from {low:g} to {high:g}, sensor size {size}",
            do="check the sensor size, and whether the file counts pixels from 1",
        )
