"""AEDAT2, the files of jAER (and of v2e): events of DVS128 and DAVIS cameras, frames of the latter.

After `#` lines come records of eight bytes, big-endian: a 32-bit address and a 32-bit time in us,
which wraps. What the bits of an address mean depends on the camera, which newer files name in
their header (`# AEChip: ...`); of an older one the caller says the size. Addresses count from the
lower corners of the image; here x and y are as everywhere, from the upper left.

    DVS128     0 polarity (0 brighter) · 1-7 x from the right · 8-14 y · 15 external input
    DAVIS      31 is 0: 10 external input · 11 polarity (1 brighter) · 12-21 x from the right
               · 22-30 y
               31 is 1: 0-9 sample of a pixel · 10-11 what is read: 0 reset, 1 signal, 3 motion
               · 12-21 x from the left · 22-30 y

A *frame* of a DAVIS is read twice: every pixel after its reset, and again after its exposure; the
image is the difference. With a global shutter all pixels are reset before the first signal
is read, and the exposure lies between these readings; with a rolling one it is that of the first
column. Motion readings are passed over and counted.

Source: https://docs.inivation.com, "AEDAT 2.0"; the cameras' classes in jAER for the directions.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Int64, UInt32
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import blocks, head
from sharpfield.recordings.chunks import RawChunk, joined, known_size
from sharpfield.recordings.format import NO_OPTIONS, Format, ReaderOptions, begins_with
from sharpfield.recordings.recording import Chunks, Frame, ReadLog, Recording, Triggers

FIRST_LINE = b"#!AER-DAT2.0"
LONGEST_HEADER, LONGEST_LINE = 2**20, 2**14
"""Preferences of jAER may be part of it."""

CAMERAS = {
    "dvs128": (128, 128),
    "tmpdiff128": (128, 128),
    "davis240": (240, 180),
    "sbret10": (240, 180),
    "davis208": (208, 192),
    "davis346": (346, 260),
    "davis640": (640, 480),
}
"""Sizes, by a part of the name of the camera's class."""

DVS128 = CAMERAS["dvs128"]

RESET, SIGNAL, MOTION = 0, 1, 3
BITS = 10
"""Of a sample."""


@dataclass(frozen=True)
class Layout:
    """Where records begin, and how to understand them."""

    path: Path
    begin: int
    size: tuple[int, int]
    trouble: ReadLog

    @property
    def davis(self) -> bool:
        """Whether addresses are those of a DAVIS."""
        return self.size != DVS128


def open_aedat2(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a file of jAER.

    Args:
        path: Of the file.
        options: `size`, which identifies the camera where the header does not.

    Raises:
        CaptureError: It is no AEDAT2, or its camera is not known.
    """
    start = head(path, LONGEST_HEADER)
    if not start.startswith(FIRST_LINE):
        raise CaptureError("the file is no AEDAT2", where=path, got=start[:16])
    lines, begin = _header(start)
    chip = next(
        (line.partition(":")[2] for line in lines if line.startswith("AEChip:")), ""
    ).strip()
    stated = next((size for name, size in CAMERAS.items() if name in chip.lower()), None)
    size = known_size(stated, options.size, path)
    if size not in CAMERAS.values():
        known = ", ".join(
            f"{width} x {height}" for width, height in dict.fromkeys(CAMERAS.values())
        )
        raise CaptureError(
            "addresses of this camera are not known",
            where=path,
            got=f"{size[0]} x {size[1]} pixels, {chip or 'no AEChip in the header'}",
            do=f"give the size of one of the cameras known: {known}",
        )
    layout = Layout(path, begin, size, ReadLog())
    return Recording(
        path,
        "AEDAT2",
        size,
        events=partial(_events, layout),
        frames=partial(_frames, layout) if layout.davis else None,
        triggers=partial(_triggers, layout),
        trouble=layout.trouble,
        notes={"camera": chip.rpartition(".")[2]} if chip else {},
    )


def _header(start: bytes) -> tuple[list[str], int]:
    """Its lines without their `#`, and where it ends."""
    lines: list[str] = []
    at = 0
    while start[at : at + 1] == b"#" and (end := start.find(b"\n", at, at + LONGEST_LINE)) >= 0:
        text = start[at + 1 : end]
        # A record may begin with the byte of "#", too; no text has a zero.
        if b"\0" in text:
            break
        lines.append(text.decode("latin-1").strip())
        at = end + 1
    return lines, at


def _records(layout: Layout) -> Iterator[tuple[UInt32[np.ndarray, "n"], Int64[np.ndarray, "n"]]]:
    """Addresses and unwrapped times of consecutive records."""
    rest, before = b"", -1
    for block in blocks(layout.path, layout.begin):
        data = rest + block
        whole = len(data) // 8 * 8
        records = np.frombuffer(data[:whole], ">u4").reshape(-1, 2).astype(np.uint32)
        rest = data[whole:]
        if len(records):
            t_us = _unwrapped(records[:, 1], before)
            before = int(t_us[-1])
            yield records[:, 0], t_us
    layout.trouble.note("torn records", int(len(rest) > 0))


def _events(layout: Layout) -> Chunks:
    layout = replace(layout, trouble=layout.trouble.anew("events"))
    return joined(_pieces(layout), layout.size, where=layout.path, trouble=layout.trouble)


def _pieces(layout: Layout) -> Iterator[RawChunk]:
    width, height = layout.size
    for address, t_us in _records(layout):
        if layout.davis:
            columns, count, motion = _davis(address, t_us, width, height)
            layout.trouble.note("words of motion readings", motion)
        else:
            columns, count, unknown = _dvs128(address, t_us)
            layout.trouble.note("records of no known kind", unknown)
        yield RawChunk(*columns)[:count]


def _triggers(layout: Layout) -> Triggers:
    """The file tells when the input changed, and not which way: all edges are rising ones."""
    layout = replace(layout, trouble=layout.trouble.anew("triggers"))
    used, external = (0x8000_0400, 0x400) if layout.davis else (0xFFFF_8000, 0x8000)
    found = [t_us[address & np.uint32(used) == external] for address, t_us in _records(layout)]
    t_us = np.concatenate([np.empty(0, np.int64), *found])
    return Triggers(t_us, np.ones(len(t_us), np.int8), np.zeros(len(t_us), np.uint8))


def _frames(layout: Layout) -> Iterator[Frame]:
    """Images of a DAVIS, scaled to 16 bits."""
    layout = replace(layout, trouble=layout.trouble.anew("frames"))
    reading = _Reading(layout)
    for address, t_us in _records(layout):
        samples = (address >> np.uint32(31) == 1) & (address >> np.uint32(10) & 3 != MOTION)
        yield from reading.taken(address[samples], t_us[samples])
    yield from reading.finished()


class _Reading:
    """Samples, collected until a frame is whole."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        width, height = layout.size
        self._samples = np.full((2, height, width), -1, np.int16)
        self._spans: list[list[int] | None] = [None, None]
        """First and last time of either reading."""

    def taken(
        self, address: UInt32[np.ndarray, "n"], t_us: Int64[np.ndarray, "n"]
    ) -> Iterator[Frame]:
        """Sort in the next samples; a frame whenever a new one begins."""
        kind = (address >> np.uint32(10) & 3).astype(np.int8)
        # A frame begins where signals end and resets follow, unless both are interleaved.
        for first, last in _runs(kind):
            reading = int(kind[first])
            if reading not in (RESET, SIGNAL):
                self._layout.trouble.note("samples of an unknown kind", last - first)
                continue
            if reading == RESET and self._whole(SIGNAL):
                yield from self.finished()
            self._put(reading, address[first:last], t_us[first:last])

    def finished(self) -> Iterator[Frame]:
        """The frame collected, if it is whole; the next one may begin."""
        reset, signal = self._spans
        if reset is not None or signal is not None:
            if self._whole(RESET) and self._whole(SIGNAL) and reset and signal:
                difference = self._samples[RESET] - self._samples[SIGNAL]
                image = np.clip(difference, 0, 2**BITS - 1).astype(np.uint16) << (16 - BITS)
                # Of a rolling shutter, signals begin before the last reset: the first column's.
                opened = reset[1] if reset[1] <= signal[0] else reset[0]
                if opened <= signal[0]:
                    yield Frame(image, opened, signal[0])
            else:
                self._layout.trouble.note("torn frames")
        self._samples[:] = -1
        self._spans = [None, None]

    def _whole(self, reading: int) -> bool:
        return bool((self._samples[reading] >= 0).all())

    def _put(
        self, reading: int, address: UInt32[np.ndarray, "n"], t_us: Int64[np.ndarray, "n"]
    ) -> None:
        width, height = self._layout.size
        x = (address >> np.uint32(12) & 0x3FF).astype(np.int64)
        y = height - 1 - (address >> np.uint32(22) & 0x1FF).astype(np.int64)
        inside = (x < width) & (y >= 0)
        self._layout.trouble.note("samples outside the sensor", int((~inside).sum()))
        samples = (address & (2**BITS - 1)).astype(np.int16)
        self._samples[reading, y[inside], x[inside]] = samples[inside]
        span = self._spans[reading] or [int(t_us[0]), int(t_us[0])]
        self._spans[reading] = [span[0], int(t_us[-1])]


def _runs(kind: np.ndarray) -> Iterator[tuple[int, int]]:
    """Begin and end of each run of equal values."""
    ends = [*(np.flatnonzero(np.diff(kind)) + 1).tolist(), len(kind)]
    begins = [0, *ends[:-1]]
    return ((first, last) for first, last in zip(begins, ends, strict=True) if last > first)


@njit(cache=True, nogil=True)
@no_type_check
def _unwrapped(t, before):
    """Times that go on where 32 bits wrap: always by the shorter way, be it backwards."""
    t_us = np.empty(t.size, np.int64)
    if before < 0 and t.size:
        before = np.int64(t[0])
    for i in range(t.size):
        step = (np.int64(t[i]) - before) & 0xFFFFFFFF
        before += step - 0x100000000 if step >= 0x80000000 else step
        t_us[i] = before
    return t_us


@njit(cache=True, nogil=True)
@no_type_check
def _davis(address, t, width, height):
    """x, y, t and p of events, how many there are, and how many words of motion readings."""
    x, y = np.empty(t.size, np.uint16), np.empty(t.size, np.uint16)
    t_us, p = np.empty(t.size, np.int64), np.empty(t.size, np.int8)
    count = motion = 0
    for i in range(t.size):
        word = np.int64(address[i])
        if word & 0x80000400 == 0:
            # Beyond the border these become negative, which as unsigned is outside too.
            x[count] = width - 1 - ((word >> 12) & 0x3FF)
            y[count] = height - 1 - ((word >> 22) & 0x1FF)
            t_us[count], p[count] = t[i], 1 if word & 0x800 else -1
            count += 1
        elif word & 0x80000C00 == 0x80000C00:
            motion += 1
    return (x, y, t_us, p), count, motion


@njit(cache=True, nogil=True)
@no_type_check
def _dvs128(address, t):
    """x, y, t and p of events, how many there are, and how many records are of no known kind."""
    x, y = np.empty(t.size, np.uint16), np.empty(t.size, np.uint16)
    t_us, p = np.empty(t.size, np.int64), np.empty(t.size, np.int8)
    count = unknown = 0
    for i in range(t.size):
        word = np.int64(address[i])
        if word >> 15 == 0:
            x[count], y[count] = 127 - ((word >> 1) & 0x7F), 127 - (word >> 8)
            t_us[count], p[count] = t[i], -1 if word & 1 else 1
            count += 1
        elif word >> 16:
            unknown += 1
    return (x, y, t_us, p), count, unknown


FORMAT = Format(
    "aedat2",
    open_aedat2,
    holds="events, frames of DAVIS with exposures, triggers",
    marks="`#!AER-DAT2`",
    recognise=begins_with(b"#!AER-DAT2", b"#!AER-DAT1"),
    suffixes=(".aedat",),
)
