"""Bounds-checked reading of FlatBuffers, as far as AEDAT4 needs it.

A *table* is an offset in a buffer; a *field* is its index in the schema. Missing fields have
their default value. A buffer begins with its size, the offset of its root table, and a file
identifier of four letters. Source: the FlatBuffers documentation, "Internals".
"""

import struct
from dataclasses import dataclass

from sharpfield.recordings.bytes import Bytes, DamagedData

PREFIX = 12
"""Bytes of size, root offset and identifier at the beginning."""


@dataclass(frozen=True)
class Table:
    """A table in a buffer."""

    data: Bytes
    offset: int

    def number(self, field: int, kind: str, default: int = 0) -> int:
        """Read a number.

        Args:
            field: Index of the field.
            kind: `struct` format character of its type: "q" for int64.
            default: Value if the table does not have the field.
        """
        where = self._field(field)
        return default if where is None else _number(self.data, where, kind)

    def vector(self, field: int, item: int) -> memoryview:
        """Bytes of a vector; empty if the table does not have the field.

        Args:
            field: Index of the field.
            item: Bytes per entry.
        """
        where = self._field(field)
        if where is None:
            return memoryview(b"")
        begin = where + _number(self.data, where, "I")
        count = _number(self.data, begin, "I")
        if count * item > len(self.data) - begin - 4:
            raise DamagedData(f"a vector of {count} entries")
        return memoryview(self.data)[begin + 4 : begin + 4 + count * item]

    def tables(self, field: int) -> list["Table"]:
        """Tables of a vector of tables."""
        offsets = self.vector(field, 4)
        if not len(offsets):
            return []
        where = self._field(field)
        assert where is not None
        begin = where + _number(self.data, where, "I") + 4
        tables = [
            begin + 4 * i + offset for i, (offset,) in enumerate(struct.iter_unpack("<I", offsets))
        ]
        return [Table(self.data, table) for table in tables]

    def _field(self, field: int) -> int | None:
        index = self.offset - _number(self.data, self.offset, "i")
        entry = 4 + 2 * field
        if entry + 2 > _number(self.data, index, "H"):
            return None
        offset = _number(self.data, index + entry, "H")
        return self.offset + offset if offset else None


def root(data: Bytes, name: str) -> Table:
    """Root table of a buffer that begins with its size.

    Raises:
        DamagedData: The identifier is another, or the buffer does not fit in the data.
    """
    if len(data) < PREFIX or data[8:12] != name.encode():
        raise DamagedData(f"no {name} buffer")
    if _number(data, 0, "I") + 4 > len(data):
        raise DamagedData("a truncated buffer")
    return Table(data, 4 + _number(data, 4, "I"))


def _number(data: Bytes, offset: int, kind: str) -> int:
    if offset < 0 or offset + struct.calcsize(f"<{kind}") > len(data):
        raise DamagedData(f"an offset to {offset} in {len(data)} bytes")
    return struct.unpack_from(f"<{kind}", data, offset)[0]
