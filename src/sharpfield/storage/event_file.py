"""An open file of events that is read on demand: a time window, a range, or chunk by chunk."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour, checked
from sharpfield.storage.arrays import UNREADABLE
from sharpfield.storage.event_columns import Stored, coordinates, polarity, whole_us

CHUNK = 2**20
"""Events per chunk; bounds the memory of reading a file."""

SEARCHED = 2**16
"""Times decompressed at once when searching for one: about one HDF5 chunk."""

THOUSAND = (300.0, 3000.0)
"""A ratio of two durations in this range is taken for a factor of 1000 between their units."""


@runtime_checkable
class Column(Protocol):
    """A one-dimensional array that is read in parts."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice, /) -> Any: ...


@dataclass(frozen=True)
class EventFile:
    """Events on disk. Close it, or use it in a `with` statement."""

    path: Path
    columns: Mapping[str, Column]
    unit: str | None
    """Unit of the stored times: ns, us, ms or s. None if neither file nor caller states it."""
    size: tuple[int, int] | None
    """Sensor resolution, width and height; None if neither file nor caller states it."""
    offset_us: int = 0
    """Origin of the stored times."""
    ms_to_idx: Column | None = None
    bayer: str = ""
    site_colour: SiteColour | None = None
    thresholds: tuple[float, float] | None = None
    """Contrast thresholds (natural log), negative and positive, where the file states them."""
    tracks: int = 1
    """Number of cameras; where there are several, the column `track` is the camera of an event."""
    resources: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> "EventFile":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.resources.close()

    def __len__(self) -> int:
        """Number of events."""
        return len(self.columns["t"])

    def part(self, first: int, last: int) -> EventStream:
        """Events number `first` to `last - 1`; their order is not checked.

        Raises:
            CaptureError: They cannot be read, or the unit or the size is not known.
        """
        width, height = self._needed_size()
        return EventStream(
            x=coordinates(self.stored("x", first, last), "x", self.path),
            y=coordinates(self.stored("y", first, last), "y", self.path),
            t_us=self._times(first, last),
            p=polarity(self.stored("p", first, last), self.path),
            width=width,
            height=height,
            bayer=self.bayer,
            site_colour=self.site_colour,
            track=self.stored("track", first, last) if "track" in self.columns else None,
            tracks=self.tracks,
        )

    def window(self, start_us: int, end_us: int) -> EventStream:
        """Events with start <= t < end, found without reading the others."""
        return self.part(self.first_at(start_us), self.first_at(end_us))

    def chunks(self, first: int = 0, last: int | None = None) -> Iterator[EventStream]:
        """Consecutive events, `CHUNK` at a time, checked within and across chunks.

        Raises:
            CaptureError: See `core.events.checked`.
        """
        last = len(self) if last is None else last
        before: int | None = None
        for begin in range(first, last, CHUNK):
            end = min(begin + CHUNK, last)
            chunk = checked(self.part(begin, end), f"{self.path}, events {begin} to {end - 1}")
            if before is not None and chunk.t_us[0] < before:
                raise CaptureError(
                    "event times are not ascending",
                    where=self.path,
                    got=f"event {begin - 1} at {before} us, event {begin} at {chunk.t_us[0]} us",
                    do="sort the events by time (stable), and check that clock wraps were undone",
                )
            before = int(chunk.t_us[-1])
            yield chunk

    def check(self) -> None:
        """Read and check every event once, in bounded memory.

        Raises:
            CaptureError: See `core.events.checked`.
        """
        for _ in self.chunks():
            pass

    def span_us(self) -> tuple[int, int]:
        """Times of the first and the last event; (0, 0) if there are none."""
        if not len(self):
            return 0, 0
        return int(self._times(0, 1)[0]), int(self._times(len(self) - 1, len(self))[0])

    def expect_overlap(self, known_us: tuple[int, int], *, known: str, do: str) -> None:
        """Check that events were recorded at the same time as something else, such as poses.

        A wrong unit of time is the commonest mistake of all.

        Args:
            known_us: First and last time of the other clock.
            known: What the other clock belongs to, e.g. "poses".
            do: How to give another unit.

        Raises:
            CaptureError: The two do not overlap, or one lasts about 1000 times as long as the
                other.
        """
        events_us = self.span_us()
        lasts, expected = (max(span[1] - span[0], 1) for span in (events_us, known_us))
        common = min(events_us[1], known_us[1]) - max(events_us[0], known_us[0])
        hint = _unit_hint(lasts / expected)
        if common >= 0 and not hint:
            return
        hint = hint or _unit_hint(max(events_us[1], 1) / max(known_us[1], 1))
        raise CaptureError(
            f"events and {known} were not taken at the same time",
            where=self.path,
            got=f"events from {events_us[0]} to {events_us[1]} us,"
            f" {known} from {known_us[0]} to {known_us[1]} us",
            do=f"{hint}: {do}" if hint else f"check that both count from the same instant; {do}",
        )

    def first_at(self, time_us: int) -> int:
        """Index of the first event at or after a time; the number of events if there is none."""
        low, high = 0, len(self)
        if self.ms_to_idx is not None and len(self.ms_to_idx):
            ms = (time_us - self.offset_us) // 1000
            marks = len(self.ms_to_idx)
            if ms >= 0:
                low = int(self.ms_to_idx[min(ms, marks - 1) : min(ms, marks - 1) + 1][0])
            if ms + 1 < marks:
                high = int(self.ms_to_idx[max(ms, -1) + 1 : max(ms, -1) + 2][0])
        while high - low > SEARCHED:
            middle = (low + high) // 2
            if self._times(middle, middle + 1)[0] < time_us:
                low = middle + 1
            else:
                high = middle
        return low + int(np.searchsorted(self._times(low, high), time_us))

    def stored(self, name: str, first: int, last: int) -> Stored:
        """A part of a column as the file stores it.

        Raises:
            CaptureError: It cannot be read.
        """
        try:
            return self.columns[name][first:last]
        except UNREADABLE as error:
            raise CaptureError(
                "cannot read events",
                where=f"{self.path}, column {name}, events {first} to {last - 1}",
                got=error,
                do="the file may be truncated: copy or convert it again",
            ) from None

    def _times(self, first: int, last: int) -> Int64[np.ndarray, "n"]:
        if self.unit is None:
            raise CaptureError(
                "the file does not state the unit of its event times",
                where=self.path,
                do="give the unit: ns, us, ms or s",
            )
        return whole_us(self.stored("t", first, last), self.unit, self.path) + self.offset_us

    def _needed_size(self) -> tuple[int, int]:
        if self.size is None:
            raise CaptureError(
                "the file does not state its sensor resolution",
                where=self.path,
                do="give width and height in pixels",
            )
        return self.size


def expect_later(events: EventStream, last_us: int | None, path: Path) -> None:
    """Check events that are to be written after those up to `last_us`.

    Raises:
        CaptureError: They are earlier or invalid.
    """
    checked(events, f"{path}, being written")
    if last_us is not None and events.t_us[0] < last_us:
        raise CaptureError(
            "appended events begin before the last ones written",
            where=path,
            got=f"{events.t_us[0]} us after {last_us} us",
            do="append chunks in the order of time",
        )


def _unit_hint(ratio: float) -> str:
    if THOUSAND[0] < ratio < THOUSAND[1]:
        return "event times look like ns where us were expected"
    if THOUSAND[0] < 1 / ratio < THOUSAND[1]:
        return "event times look like us where ns were expected"
    return ""
