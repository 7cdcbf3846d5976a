"""Payloads of `event_camera_msgs` that are not Prophesee's: `libcaer_cmp`, `libcaer`, `mono`.

    libcaer_cmp  16-bit words, type in the top 4 bits: 0 time, upper 12 bits · 1 time, lower 12 bits
                 (us, within the packet) · 2 x, 11 bits · 3 y and, in bit 11, polarity: an event
                 · 4 y and polarity of events to follow · 5 which of 8 rows from there have one
    libcaer      8 bytes: valid · polarity · y, 15 bits · x, 15 bits; and 31 bits of us
    mono         8 bytes: 32 bits of ns · x, 16 bits · y, 15 bits · polarity

All times count from the `time_base` of their packet, in ns.

Source: the package event_camera_codecs of the ros-event-camera project.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sharpfield.recordings.chunks import RawChunk

ENCODINGS = ("libcaer_cmp", "libcaer", "mono")


def decode(encoding: str, payload: memoryview, base_ns: int) -> RawChunk:
    """Decode the events of a packet.

    Args:
        encoding: One of `ENCODINGS`.
        payload: The encoded events; a truncated word at the end is left out.
        base_ns: `time_base` of the packet.
    """
    if encoding == "libcaer_cmp":
        words = np.frombuffer(payload, "<u2", len(payload) // 2)
        *columns, count = _compressed(words, base_ns, _max_events(words))
        return RawChunk(*columns)[:count]
    words = np.frombuffer(payload, "<u4", len(payload) // 8 * 2).reshape(-1, 2)
    return RawChunk(*(_plain if encoding == "libcaer" else _mono)(words, base_ns))


@njit(cache=True, nogil=True)
@no_type_check
def _max_events(words):
    """Upper bound of the number of events."""
    count = 0
    for i in range(words.size):
        kind = words[i] >> 12
        count += 1 if kind == 3 else 8 if kind == 5 else 0
    return count


@njit(cache=True, nogil=True)
@no_type_check
def _compressed(words, base_ns, most):
    x, y = np.empty(most, np.uint16), np.empty(most, np.uint16)
    t_us, p = np.empty(most, np.int64), np.empty(most, np.int8)
    polarity = -1
    count = high = low = column = base = 0
    sign = -1
    for i in range(words.size):
        kind, value = words[i] >> 12, np.int64(words[i] & 0xFFF)
        bits, row = 0, base
        if kind == 0:
            high = value << 12
        elif kind == 1:
            low = value
        elif kind == 2:
            column = value & 0x7FF
        elif kind == 3:
            bits, row, polarity = 1, value & 0x7FF, 1 if value & 0x800 else -1
        elif kind == 4:
            base, sign = value & 0x7FF, 1 if value & 0x800 else -1
        elif kind == 5:
            bits, polarity = value & 0xFF, sign
            base += 8
        while bits:
            if bits & 1:
                x[count], y[count], p[count] = column, row, polarity
                t_us[count] = (base_ns + 1000 * (high | low) + 500) // 1000
                count += 1
            bits >>= 1
            row += 1
    return x, y, t_us, p, count


@njit(cache=True, nogil=True)
@no_type_check
def _plain(words, base_ns):
    x, y = np.empty(len(words), np.uint16), np.empty(len(words), np.uint16)
    t_us, p = np.empty(len(words), np.int64), np.empty(len(words), np.int8)
    wraps = before = np.int64(0)
    for i in range(len(words)):
        word, time = words[i, 0], np.int64(words[i, 1] & 0x7FFFFFFF)
        wraps += 1 if time < before else 0
        before = time
        x[i], y[i] = word >> 17, (word >> 2) & 0x7FFF
        p[i] = 1 if word & 2 else -1
        t_us[i] = (base_ns + 500) // 1000 + (wraps << 31) + time
    return x, y, t_us, p


@njit(cache=True, nogil=True)
@no_type_check
def _mono(words, base_ns):
    x, y = np.empty(len(words), np.uint16), np.empty(len(words), np.uint16)
    t_us, p = np.empty(len(words), np.int64), np.empty(len(words), np.int8)
    for i in range(len(words)):
        word = words[i, 1]
        x[i], y[i] = word & 0xFFFF, (word >> 16) & 0x7FFF
        p[i] = 1 if word >> 31 else -1
        t_us[i] = (base_ns + np.int64(words[i, 0]) + 500) // 1000
    return x, y, t_us, p
