"""Bounds-checked reading of FlatBuffers, as far as AEDAT4 needs it.

A *table* is a place in a buffer; a *field* is numbered in the order of its schema. Missing fields
read as their default. A buffer begins with its size, the offset of its root table, and four
letters that name its kind. Source: the FlatBuffers documentation, "Internals".
"""

import struct
from dataclasses import dataclass

from sharpfield.recordings.bytes import Bytes, Damaged

PREFIX = 12
"""Bytes of size, root and name before everything else."""


@dataclass(frozen=True)
class Table:
    """A table in a buffer."""

    data: Bytes
    place: int

    def number(self, field: int, kind: str, default: int = 0) -> int:
        """A number.

        Args:
            field: Which.
            kind: Its type, as `struct` calls it: "q" for int64.
            default: If the table does not have it.
        """
        where = self._field(field)
        return default if where is None else _number(self.data, where, kind)

    def vector(self, field: int, item: int) -> memoryview:
        """The bytes of a vector; empty if there is none.

        Args:
            field: Which.
            item: Bytes of an entry.
        """
        where = self._field(field)
        if where is None:
            return memoryview(b"")
        begin = where + _number(self.data, where, "I")
        count = _number(self.data, begin, "I")
        if count * item > len(self.data) - begin - 4:
            raise Damaged(f"a vector of {count} entries")
        return memoryview(self.data)[begin + 4 : begin + 4 + count * item]

    def tables(self, field: int) -> list["Table"]:
        """The tables of a vector of tables."""
        offsets = self.vector(field, 4)
        if not len(offsets):
            return []
        where = self._field(field)
        assert where is not None
        begin = where + _number(self.data, where, "I") + 4
        places = [
            begin + 4 * i + offset for i, (offset,) in enumerate(struct.iter_unpack("<I", offsets))
        ]
        return [Table(self.data, place) for place in places]

    def _field(self, field: int) -> int | None:
        index = self.place - _number(self.data, self.place, "i")
        entry = 4 + 2 * field
        if entry + 2 > _number(self.data, index, "H"):
            return None
        offset = _number(self.data, index + entry, "H")
        return self.place + offset if offset else None


def root(data: Bytes, name: str) -> Table:
    """The root table of a buffer that begins with its size.

    Raises:
        Damaged: It is of another kind, or does not fit in the data.
    """
    if len(data) < PREFIX or data[8:12] != name.encode():
        raise Damaged(f"no {name} buffer")
    if _number(data, 0, "I") + 4 > len(data):
        raise Damaged("a torn buffer")
    return Table(data, 4 + _number(data, 4, "I"))


def _number(data: Bytes, place: int, kind: str) -> int:
    if place < 0 or place + struct.calcsize(f"<{kind}") > len(data):
        raise Damaged(f"an offset to {place} in {len(data)} bytes")
    return struct.unpack_from(f"<{kind}", data, place)[0]
