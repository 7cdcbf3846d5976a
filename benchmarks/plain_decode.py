"""Event files decoded by numpy alone, whole and without state: what `decode` compares with.

Each takes the bytes after the header and gives x, y, t in us, and whether brighter; `bag` takes a
bag of ROS 1, which another library opens.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

Events = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def evt2(data: bytes) -> Events:
    words = np.frombuffer(data, "<u4")
    return _pixels(words, _unwrapped(words >> 28 == 8, words & 0xFFFFFFF, 2**28))


def evt21(data: bytes) -> Events:
    low, words = np.frombuffer(data, "<u4").reshape(-1, 2).T
    high = _unwrapped(words >> 28 == 8, words & 0xFFFFFFF, 2**28)
    events = words >> 28 <= 1
    bits = np.unpackbits(low[events][:, None].view(np.uint8), axis=1, bitorder="little")
    word, offset = np.nonzero(bits)
    x, y, t, bright = _pixels(words[events], high[events])
    return x[word] + offset, y[word], t[word], bright[word]


def evt3(data: bytes) -> Events:
    words = np.frombuffer(data, "<u2")
    kind, number = words >> 12, words & 0xFFF
    high = _unwrapped(kind == 8, number, 2**12)
    changed = np.diff(high, prepend=-1) != 0
    low = _latest((kind == 6) | changed, np.where(kind == 6, number, 0))
    t = high << 12 | low
    y = _latest(kind == 0, number & 0x7FF)
    base = kind == 3
    length = np.where(kind == 4, 12, 0) + np.where(kind == 5, 8, 0)
    before = np.cumsum(length) - length
    start = _latest(base, (number & 0x7FF) - before) + before
    bright = np.where(kind == 2, number, _latest(base, number)) >> 11
    bits = np.where(kind == 2, 1, np.where(kind == 4, number, number & 0xFF) * (length > 0))
    set_bits = np.unpackbits(bits[:, None].astype("<u2").view(np.uint8), axis=1, bitorder="little")
    word, offset = np.nonzero(set_bits)
    x = np.where(kind == 2, number & 0x7FF, start)
    return x[word] + offset, y[word], t[word], bright[word]


def dat(data: bytes) -> Events:
    time, place = np.frombuffer(data[2:], "<u4").reshape(-1, 2).T
    wraps = np.cumsum(np.diff(time.astype(np.int64), prepend=time[:1]) < -(2**31))
    return place & 0x3FFF, place >> 14 & 0x3FFF, time + (wraps << 32), place >> 28


def bag(path: Path) -> Events:
    bags: Any = importlib.import_module("rosbags.rosbag1")
    event = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("on", "u1")])
    parts = []
    with bags.Reader(path) as reader:
        for _, _, data in reader.messages():
            # A header of 12 bytes and a text, then height, width and number of events.
            begin = 16 + int.from_bytes(data[12:16], "little") + 12
            parts.append(np.frombuffer(data, event, offset=begin))
    found = np.concatenate(parts)
    t = found["s"] * np.int64(10**6) + (found["ns"] + 500) // 1000
    return found["x"].copy(), found["y"].copy(), t, found["on"] > 0


PLAIN = {"EVT2": evt2, "EVT2.1": evt21, "EVT3": evt3, "DAT": dat}


def _pixels(words: np.ndarray, high: np.ndarray) -> Events:
    events = words >> 28 <= 1
    words, t = words[events], high[events] << 6 | (words[events] >> 22 & 0x3F)
    return words >> 11 & 0x7FF, words & 0x7FF, t, words >> 28


def _unwrapped(set_here: np.ndarray, counter: np.ndarray, period: int) -> np.ndarray:
    """The last counter that was set, wraps undone."""
    found = _latest(set_here, counter)
    return found + period * np.cumsum(np.diff(found, prepend=found[:1]) < -period // 2)


def _latest(set_here: np.ndarray, value: np.ndarray) -> np.ndarray:
    """At each place, the value at the last place where it was set."""
    place = np.maximum.accumulate(np.where(set_here, np.arange(len(set_here)), 0))
    return value[place].astype(np.int64)
