"""Writes the FlatBuffers that test files of AEDAT4 are made of; read by `aedat.flatbuffers`."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from sharpfield.recordings.aedat.aedat4 import PREFIX


@dataclass(frozen=True)
class Scalar:
    """A number to be written."""

    field: int
    kind: str
    value: int


@dataclass(frozen=True)
class Vector:
    """Entries to be written, already packed."""

    field: int
    entries: bytes
    count: int


@dataclass(frozen=True)
class Tables:
    """A vector of tables to be written."""

    field: int
    tables: Sequence[Sequence[Scalar]]


Part = Scalar | Vector | Tables


def packed(name: str, parts: Sequence[Part]) -> bytes:
    """A buffer with its size before it.

    Everything is aligned to eight bytes from the first, as the format asks for 64-bit entries.
    """
    body = bytearray(PREFIX)
    place = _append(body, parts)
    body += bytes(_aligned(len(body)) - len(body))
    struct.pack_into("<II4s", body, 0, len(body) - 4, place - 4, name.encode())
    return bytes(body)


def _append(body: bytearray, parts: Sequence[Part]) -> int:
    """Append a table, and what it points to; where it begins."""
    offsets: dict[int, int] = {}
    end = 4  # of the table; it begins with the way to its index
    # The widest fields first: then each is aligned once the table begins four bytes late.
    for part in sorted(parts, key=_width, reverse=True):
        offsets[part.field] = end
        end += _width(part)
    fields = max(offsets) + 1
    entries = [offsets.get(field, 0) for field in range(fields)]
    index = struct.pack(f"<HH{fields}H", 4 + 2 * fields, end, *entries)
    place = _aligned(len(body) + len(index)) + 4
    body += bytes(place + end - len(body))
    body[place - len(index) : place] = index
    struct.pack_into("<i", body, place, len(index))
    for part in parts:
        where = place + offsets[part.field]
        if isinstance(part, Scalar):
            struct.pack_into(f"<{part.kind}", body, where, part.value)
            continue
        body += bytes(_aligned(len(body)) + 4 - len(body))
        begin = len(body)
        struct.pack_into("<I", body, where, begin - where)
        if isinstance(part, Vector):
            body += struct.pack("<I", part.count) + part.entries
            continue
        body += struct.pack("<I", len(part.tables)) + bytes(4 * len(part.tables))
        for i, table in enumerate(part.tables):
            entry = begin + 4 + 4 * i
            struct.pack_into("<I", body, entry, _append(body, table) - entry)
    return place


def _width(part: Part) -> int:
    return struct.calcsize(part.kind) if isinstance(part, Scalar) else 4


def _aligned(place: int) -> int:
    return (place + 7) // 8 * 8
