import struct

import pytest

from sharpfield.recordings.aedat.aedat4 import root
from sharpfield.recordings.bytes import DamagedData
from tests.recordings.aedat.flatbuffer_writer import Scalar, Tables, Vector, packed

# By hand: size, root at 20, name; index of 8 bytes (two fields, at 4 and 8 of a table of 12 bytes);
# table: way to its index, a number, the way to a vector; the vector: two entries of 16 bits.
BY_HAND = struct.pack("<II4sHHHHiIIIHH", 36, 16, b"NAME", 8, 12, 4, 8, 8, 77, 4, 2, 500, 600)


def test_a_buffer_laid_out_by_hand() -> None:
    table = root(BY_HAND, "NAME")
    assert table.number(0, "I") == 77
    assert bytes(table.vector(1, 2)) == struct.pack("<HH", 500, 600)
    assert table.number(2, "q", 5) == 5 and len(table.vector(3, 8)) == 0


def test_what_is_written_is_read() -> None:
    parts = [
        Scalar(0, "b", -3),
        Scalar(1, "q", -(2**60)),
        Vector(3, b"text\0", 4),
        Scalar(4, "h", 300),
        Vector(6, bytes(range(16)), 2),
        Tables(7, [[Scalar(0, "q", 9)], [Scalar(0, "q", 10), Scalar(1, "b", 1)], []][:2]),
    ]
    data = packed("ABCD", parts)
    table = root(data, "ABCD")
    assert (table.number(0, "b"), table.number(1, "q"), table.number(4, "h")) == (-3, -(2**60), 300)
    assert table.number(2, "i", -1) == -1
    assert bytes(table.vector(3, 1)) == b"text"
    assert bytes(table.vector(6, 8)) == bytes(range(16))
    assert [one.number(0, "q") for one in table.tables(7)] == [9, 10]
    assert [one.number(1, "b") for one in table.tables(7)] == [0, 1]
    assert table.tables(8) == []


def test_wide_entries_are_aligned() -> None:
    entries = bytes(range(1, 17))
    for length in range(1, 9):
        data = packed("ABCD", [Scalar(1, "q", 0x0102030405060708), Vector(0, bytes(length), 1),
                               Vector(2, entries, 2), Scalar(3, "b", 1)])  # fmt: skip
        assert data.index(struct.pack("<q", 0x0102030405060708)) % 8 == 0
        assert data.index(entries) % 8 == 0


@pytest.mark.parametrize("place", range(0, len(BY_HAND), 4))
def test_offsets_are_not_trusted(place: int) -> None:
    for value in (0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, 1000):
        data = bytearray(BY_HAND)
        struct.pack_into("<I", data, place, value)
        try:
            table = root(bytes(data), "NAME")
            table.number(0, "I")
            table.vector(1, 2)
            table.tables(1)
        except DamagedData:
            continue


def test_torn_buffers_are_refused() -> None:
    for length in range(len(BY_HAND)):
        with pytest.raises(DamagedData):
            root(BY_HAND[:length], "NAME")
    with pytest.raises(DamagedData, match="no FRME buffer"):
        root(BY_HAND, "FRME")
