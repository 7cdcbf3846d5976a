import struct

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage.ply import Ply, columns, read_ply, write_ply

ROWS = np.array(
    [(1.5, -2.0, 3, 255), (0.1, 1e-9, -4, 0)],
    [("x", "f4"), ("y", "f8"), ("number", "i2"), ("red", "u1")],
)

HEADER = (
    "ply\nformat {kind} 1.0\ncomment made by hand\nobj_info 7\nelement vertex 2\n"
    "property float32 x\nproperty double y\nproperty short number\nproperty uint8 red\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


def binary(order: str) -> bytes:
    return b"".join(struct.pack(order + "fdhB", *row.item()) for row in ROWS)


def test_what_is_written_comes_back(tmp_path):
    write_ply(tmp_path / "a.ply", Ply(ROWS, ("one", "two words")))
    found = read_ply(tmp_path / "a.ply")
    assert found.comments == ("one", "two words")
    assert found.rows.dtype == ROWS.dtype
    np.testing.assert_array_equal(found.rows, ROWS)


def test_the_header_is_what_programs_expect(tmp_path):
    write_ply(tmp_path / "a.ply", Ply(ROWS, ("one",)))
    header, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert header.decode() == (
        "ply\nformat binary_little_endian 1.0\ncomment one\nelement vertex 2\n"
        "property float x\nproperty double y\nproperty short number\nproperty uchar red\n"
    )
    assert data == binary("<")


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("binary_little_endian", binary("<")),
        ("binary_big_endian", binary(">")),
        ("ascii", b"1.5 -2 3 255\n 0.1  1e-9 -4 0 \n"),
    ],
)
def test_every_kind_is_read_and_what_follows_left_alone(tmp_path, kind, data):
    path = tmp_path / "a.ply"
    path.write_bytes(HEADER.format(kind=kind).encode() + data + b"\x03\x00")
    np.testing.assert_array_equal(read_ply(path).rows, ROWS)


def test_line_ends_of_windows(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n2.5\n"
    (tmp_path / "a.ply").write_bytes(text.replace("\n", "\r\n").encode())
    assert read_ply(tmp_path / "a.ply").rows["x"].tolist() == [2.5]


def test_no_vertices(tmp_path):
    write_ply(tmp_path / "a.ply", Ply(ROWS[:0]))
    assert len(read_ply(tmp_path / "a.ply").rows) == 0
    empty = HEADER.format(kind="ascii").replace("vertex 2", "vertex 0")
    (tmp_path / "b.ply").write_text(empty)
    assert len(read_ply(tmp_path / "b.ply").rows) == 0


def test_columns():
    np.testing.assert_array_equal(columns(Ply(ROWS), ["y", "x"], where="")[0], [-2, 1.5])
    with pytest.raises(CaptureError, match="vertices have no z\n  where  a.ply\n  got    x, y, nu"):
        columns(Ply(ROWS), ["x", "z"], where="a.ply")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not a PLY file"),
        (b"solid cube\n", "not a PLY file"),
        (b"\x00" * 3000, "not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "the header of a PLY file has no end"),
        (b"ply\n" + b"comment x\n" * 9000, "the header of a PLY file has no end"),
        (b"ply\nformat utf-7 1.0\nend_header\n", "got    format utf-7 1.0"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "got    no format"),
        (b"ply\nformat ascii 1.0\nend_header\n", "got    no vertices"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "got    element face 1"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "got    element vertex -1"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int a\nend_header\n",
            "got    property list uchar int a",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half a\nend_header\n",
            "got    property half a",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\n"
            b"property float a\nproperty float a\nend_header\n",
            "got    a property twice",
        ),
        (HEADER.format(kind="ascii").encode() + b"1 2 3 4\n", "got    1 of 2 vertices"),
        (HEADER.format(kind="ascii").encode() + b"1 2 3 4\na b c d\n", "got    no numbers"),
        (HEADER.format(kind="ascii").encode() + b"1 2 3 4\n1 2\n", "got    1 2"),
        (
            HEADER.format(kind="binary_little_endian").encode() + binary("<")[:-1],
            "a PLY file ends too early\n  where  .*\n  got    1 of 2 vertices",
        ),
    ],
)
def test_what_cannot_be_read_is_told(tmp_path, content, said):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=said) as error:
        read_ply(path)
    assert str(path) in str(error.value)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(CaptureError, match="file not found\n  where  .*a.ply"):
        read_ply(tmp_path / "a.ply")
