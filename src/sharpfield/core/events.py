"""Event streams: pixel, time and polarity of each change of log brightness by a threshold.

Several cameras of one kind, on one clock, share a stream; `track` tells them apart. Integer
coordinates name a pixel of the sensor (its centre is at +0.5). Float coordinates are rectified
positions *in the same index units*: 10.0 means the centre of ideal pixel 10.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int8, Int64, Shaped

from sharpfield.core.errors import CaptureError, expect_arrays


@dataclass(frozen=True)
class EventStream:
    """Events of one sensor, or of several alike, in the order of time; may be memory-mapped.

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
    track: Shaped[np.ndarray, "n"] | None = None
    """Column: the track of the camera that reported, 0 ... tracks-1; None if all are of track 0."""
    tracks: int = 1
    """How many tracks there are to tell apart, whether or not their cameras report."""

    def __repr__(self) -> str:
        span = f", {self.t_us[0]} to {self.t_us[-1]} us" if len(self) else ""
        tracks = f", {self.tracks} tracks" if self.tracks > 1 else ""
        kind = f", {self.bayer or 'coloured'}" if self.coloured else ""
        return f"EventStream({len(self):,} of {self.width}x{self.height}{span}{tracks}{kind})"

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

    def __getitem__(self, part: slice | Int64[np.ndarray, "k"]) -> "EventStream":
        """A slice of the stream, as views; or the events of these numbers, copied."""
        return replace(
            self,
            x=self.x[part],
            y=self.y[part],
            t_us=self.t_us[part],
            p=self.p[part],
            track=None if self.track is None else self.track[part],
        )

    def of_track(self, track: int) -> "EventStream":
        """The events of one camera, copied; they keep their track."""
        if self.track is None:
            return self if track == 0 else self[:0]
        return self[np.flatnonzero(self.track == track)]


@dataclass(frozen=True)
class SiteColour:
    """Which colour filter lies before each rectified position: 0 red, 1 green, 2 blue."""

    x: Shaped[np.ndarray, "m"]
    y: Shaped[np.ndarray, "m"]
    channel: Int8[np.ndarray, "m"]


def checked(events: EventStream, where: object) -> EventStream:
    """The same stream, after checking that it is valid.

    Args:
        events: A whole stream, in memory (a reader of larger ones calls this for each chunk).
        where: The file, for the message.

    Raises:
        ShapeError: A column is no array, or has another type than its annotation.
        CaptureError: Counts differ, times are not ascending, a coordinate is not finite or lies
            outside the sensor, a polarity is neither -1 nor +1, or a track is not one of `tracks`.
    """
    columns = [events.x, events.y, events.t_us, events.p]
    columns += [] if events.track is None else [events.track]
    if len({len(column) for column in columns}) != 1:
        raise CaptureError(
            "event columns have different lengths",
            where=where,
            got=f"x {len(events.x)}, y {len(events.y)}, t {len(events.t_us)}, p {len(events.p)}",
            do="the file may be truncated: copy or convert it again",
        )
    expect_arrays(events)
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
    _known_tracks(events, where)
    return events


def merged(streams: Sequence[EventStream]) -> EventStream:
    """One stream of several cameras alike, in the order of time; ties keep the order given.

    Args:
        streams: At least one. Those without a track are of track 0.
    """
    track = [
        np.zeros(len(events), np.uint16) if events.track is None else events.track
        for events in streams
    ]
    columns = {
        name: np.concatenate([getattr(events, name) for events in streams])
        for name in ("x", "y", "t_us", "p")
    }
    most = max(events.tracks for events in streams)
    joined = replace(streams[0], track=np.concatenate(track), tracks=most, **columns)
    return joined[np.argsort(joined.t_us, kind="stable")]


def _known_tracks(events: EventStream, where: object) -> None:
    if events.tracks > 1 and events.track is None:
        raise CaptureError(
            "events of several cameras must say which one reported",
            where=where,
            got=f"{events.tracks} tracks and no column of tracks",
        )
    if events.track is None:
        return
    low, high = int(events.track.min()), int(events.track.max())
    if events.track.dtype.kind not in "iu" or low < 0 or high >= events.tracks:
        raise CaptureError(
            "an event belongs to no known track",
            where=where,
            got=f"tracks {low} to {high} of type {events.track.dtype}, {events.tracks} known",
            do="number the cameras from 0, and say how many there are",
        )


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
