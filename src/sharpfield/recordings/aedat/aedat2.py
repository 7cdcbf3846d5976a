"""AEDAT2, the files of jAER (and v2e): events of DVS128 and DAVIS cameras, frames of the latter.

After header lines that begin with `#` come records of eight bytes, big-endian: a 32-bit address and
a 32-bit time in us, which wraps. The bits of an address depend on the camera model, which newer
files name in their header (`# AEChip: ...`); for older files the resolution identifies it.
Addresses count from the lower corners of the image; x and y here count from the upper left.

    DVS128     0 polarity (0 brighter) · 1-7 x from the right · 8-14 y · 15 external input
    DAVIS      31 is 0: 10 external input · 11 polarity (1 brighter) · 12-21 x from the right
               · 22-30 y
               31 is 1: 0-9 sample of a pixel · 10-11 what is read: 0 reset, 1 signal, 3 motion
               · 12-21 x from the left · 22-30 y

A *frame* of a DAVIS is read out twice: every pixel after its reset, and again after its exposure;
the image is the difference. With a global shutter all pixels are reset before the first signal is
read, and the exposure lies between the two readouts; with a rolling shutter the exposure of the
first column is taken. IMU samples are skipped and counted.

Source: https://docs.inivation.com, "AEDAT 2.0"; the camera classes of jAER for the axis directions.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Int64, UInt32
from numba import njit

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import read_blocks, read_head
from sharpfield.recordings.chunks import RawChunk, merge_chunks, resolve_size
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    Frame,
    ReaderOptions,
    ReadLog,
    Recording,
    Triggers,
    begins_with,
)

FIRST_LINE = b"#!AER-DAT2.0"
MAX_HEADER, MAX_LINE = 2**20, 2**14
"""Most bytes of a header, which may hold the preferences of jAER, and of a line."""

CAMERAS = {
    "dvs128": (128, 128),
    "tmpdiff128": (128, 128),
    "davis240": (240, 180),
    "sbret10": (240, 180),
    "davis208": (208, 192),
    "davis346": (346, 260),
    "davis640": (640, 480),
}
"""Resolution by a part of the camera's class name."""

RESET, SIGNAL, IMU = 0, 1, 3
BITS = 10
"""Bits of a sample."""


@dataclass(frozen=True)
class Layout:
    """Position and meaning of the records of a file."""

    path: Path
    begin: int
    size: tuple[int, int]
    log: ReadLog

    @property
    def davis(self) -> bool:
        """Whether the addresses are those of a DAVIS."""
        return self.size != CAMERAS["dvs128"]


def open_aedat2(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a file of jAER.

    Args:
        path: The file.
        options: `size`, which identifies the camera where the header does not.

    Raises:
        CaptureError: The file is no AEDAT2, or its camera model is unknown.
    """
    start = read_head(path, MAX_HEADER)
    if not start.startswith(FIRST_LINE):
        raise CaptureError("the file is no AEDAT2", where=path, got=start[:16])
    lines, begin = _header(start)
    chip = next((line[7:].strip() for line in lines if line.startswith("AEChip:")), "")
    stated = next((size for name, size in CAMERAS.items() if name in chip.lower()), None)
    size = resolve_size(stated, options.size, path)
    if size not in CAMERAS.values():
        known = ", ".join(f"{wide} x {high}" for wide, high in dict.fromkeys(CAMERAS.values()))
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
        log=layout.log,
        notes={"camera": chip.rpartition(".")[2]} if chip else {},
    )


def _header(start: bytes) -> tuple[list[str], int]:
    """Header lines without their `#`, and the offset of the data."""
    lines: list[str] = []
    at = 0
    while start[at : at + 1] == b"#" and (end := start.find(b"\n", at, at + MAX_LINE)) >= 0:
        text = start[at + 1 : end]
        # A record may begin with the byte of "#", too; but no text has a zero byte.
        if b"\0" in text:
            break
        lines.append(text.decode("latin-1").strip())
        at = end + 1
    return lines, at


def _records(layout: Layout) -> Iterator[tuple[UInt32[np.ndarray, "n"], Int64[np.ndarray, "n"]]]:
    """Addresses and unwrapped times of consecutive records."""
    rest, before = b"", -1
    for block in read_blocks(layout.path, layout.begin):
        data = rest + block
        whole = len(data) // 8 * 8
        records = np.frombuffer(data[:whole], ">u4").reshape(-1, 2).astype(np.uint32)  # [n 2]
        rest = data[whole:]
        if len(records):
            t_us = _unwrapped(records[:, 1], before)
            before = int(t_us[-1])
            yield records[:, 0], t_us
    layout.log.note("truncated records", int(len(rest) > 0))


def _events(layout: Layout) -> Chunks:
    layout = replace(layout, log=layout.log.start("events"))
    return merge_chunks(_raw_chunks(layout), layout.size, where=layout.path, log=layout.log)


def _raw_chunks(layout: Layout) -> Iterator[RawChunk]:
    width, height = layout.size
    for address, t_us in _records(layout):
        if layout.davis:
            columns, count, imu = _davis(address, t_us, width, height)
            layout.log.note("words of IMU samples", imu)
        else:
            columns, count, unknown = _dvs128(address, t_us)
            layout.log.note("records of no known kind", unknown)
        yield RawChunk(*columns)[:count]


def _triggers(layout: Layout) -> Triggers:
    """Trigger edges; the file does not give their direction, so all are taken as rising."""
    layout = replace(layout, log=layout.log.start("triggers"))
    used, external = (0x8000_0400, 0x400) if layout.davis else (0xFFFF_8000, 0x8000)
    found = [t_us[address & np.uint32(used) == external] for address, t_us in _records(layout)]
    t_us = np.concatenate([np.empty(0, np.int64), *found])
    return Triggers(t_us, np.ones(len(t_us), np.int8), np.zeros(len(t_us), np.uint8))


def _frames(layout: Layout) -> Iterator[Frame]:
    """Frames of a DAVIS, scaled to 16 bits."""
    layout = replace(layout, log=layout.log.start("frames"))
    readout = _Readout(layout)
    for address, t_us in _records(layout):
        samples = (address >> np.uint32(31) == 1) & (address >> np.uint32(10) & 3 != IMU)
        yield from readout.add(address[samples], t_us[samples])
    yield from readout.finish()


class _Readout:
    """Collects samples until a frame is complete."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        width, height = layout.size
        self._samples = np.full((2, height, width), -1, np.int16)
        self._spans: list[list[int] | None] = [None, None]
        """First and last time of the reset and of the signal readout."""

    def add(
        self, address: UInt32[np.ndarray, "n"], t_us: Int64[np.ndarray, "n"]
    ) -> Iterator[Frame]:
        """Add samples; yields the previous frame whenever a new one begins."""
        kind = (address >> np.uint32(10) & 3).astype(np.int8)
        # A frame begins where signals end and resets follow, unless both are interleaved.
        ends = [*(np.flatnonzero(np.diff(kind)) + 1).tolist(), len(kind)] if len(kind) else []
        for first, last in pairwise([0, *ends]):
            part = int(kind[first])
            if part not in (RESET, SIGNAL):
                self._layout.log.note("samples of an unknown kind", last - first)
                continue
            if part == RESET and self._complete(SIGNAL):
                yield from self.finish()
            self._put(part, address[first:last], t_us[first:last])

    def finish(self) -> Iterator[Frame]:
        """Yield the collected frame if it is complete, and start the next one."""
        reset, signal = self._spans
        if reset is not None or signal is not None:
            if self._complete(RESET) and self._complete(SIGNAL) and reset and signal:
                difference = self._samples[RESET] - self._samples[SIGNAL]
                image = np.clip(difference, 0, 2**BITS - 1).astype(np.uint16) << (16 - BITS)
                # Rolling shutter: signals begin before the last reset; take the first column.
                opened = reset[1] if reset[1] <= signal[0] else reset[0]
                if opened <= signal[0]:
                    yield Frame(image, opened, signal[0])
            else:
                self._layout.log.note("truncated frames")
        self._samples[:] = -1
        self._spans = [None, None]

    def _complete(self, part: int) -> bool:
        return bool((self._samples[part] >= 0).all())

    def _put(
        self, part: int, address: UInt32[np.ndarray, "n"], t_us: Int64[np.ndarray, "n"]
    ) -> None:
        width, height = self._layout.size
        x = (address >> np.uint32(12) & 0x3FF).astype(np.int64)
        y = height - 1 - (address >> np.uint32(22) & 0x1FF).astype(np.int64)
        inside = (x < width) & (y >= 0)
        self._layout.log.note("samples outside the sensor", int((~inside).sum()))
        samples = (address & (2**BITS - 1)).astype(np.int16)
        self._samples[part, y[inside], x[inside]] = samples[inside]
        span = self._spans[part] or [int(t_us[0]), int(t_us[0])]
        self._spans[part] = [span[0], int(t_us[-1])]


@njit(cache=True, nogil=True)
@no_type_check
def _unwrapped(t, before):
    """Unwrapped 32-bit times: each step is the shorter one, forwards or backwards."""
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
    """x, y, t and p of the events, their number, and the number of IMU words."""
    x, y = np.empty(t.size, np.uint16), np.empty(t.size, np.uint16)
    t_us, p = np.empty(t.size, np.int64), np.empty(t.size, np.int8)
    count = imu = 0
    for i in range(t.size):
        word = np.int64(address[i])
        if word & 0x80000400 == 0:
            # Beyond the border these are negative, which is outside the sensor as unsigned, too.
            x[count] = width - 1 - ((word >> 12) & 0x3FF)
            y[count] = height - 1 - ((word >> 22) & 0x1FF)
            t_us[count], p[count] = t[i], 1 if word & 0x800 else -1
            count += 1
        elif word & 0x80000C00 == 0x80000C00:
            imu += 1
    return (x, y, t_us, p), count, imu


@njit(cache=True, nogil=True)
@no_type_check
def _dvs128(address, t):
    """x, y, t and p of the events, their number, and the number of records of unknown kind."""
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
