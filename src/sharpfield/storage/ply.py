"""PLY files: one row of numbers for each vertex, with the property names of the header.

Reading supports `ascii`, `binary_little_endian` and `binary_big_endian`, with the vertices as first
element and without list properties; what follows (faces) is ignored. Files are written in binary,
little endian. A *row* is a numpy structure with a field for each property.

Source: Greg Turk, "The PLY polygon file format" (1994).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Shaped

from sharpfield.core.errors import CaptureError
from sharpfield.core.files import replacing

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
"""numpy types by both sets of names in use."""

NAMES = {code: name for name, code in reversed(TYPES.items())}
"""The older names, which every program supports."""

ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

LONGEST_HEADER = 65_536
"""Maximum header length in bytes."""


@dataclass(frozen=True)
class Ply:
    """The vertices of a file."""

    rows: Shaped[np.ndarray, "n"]
    comments: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Header:
    kind: str
    count: int
    properties: list[tuple[str, str]]
    """Name and numpy type."""
    comments: tuple[str, ...]


def read_ply(path: Path) -> Ply:
    """Read the vertices of a file, in native byte order.

    Raises:
        CaptureError: The file is missing, truncated, or not a PLY file of plain vertices.
    """
    if not path.is_file():
        raise CaptureError("file not found", where=path, do="check the path")
    with path.open("rb") as file:
        header = _header(file, path)
        order = ORDERS[header.kind]
        row = np.dtype([(name, order + code) for name, code in header.properties])
        if header.kind == "ascii":
            return Ply(_from_text(file, header, row, path), header.comments)
        data = file.read(header.count * row.itemsize)
    if len(data) < header.count * row.itemsize:
        raise _truncated(path, len(data) // row.itemsize, header.count)
    rows = np.frombuffer(data, row)
    return Ply(rows.astype(row.newbyteorder("=")), header.comments)


def write_ply(path: Path, ply: Ply) -> None:
    """Write vertices; the file appears whole or not at all."""
    names = ply.rows.dtype.names or ()
    types = {name: ply.rows.dtype[name].str[1:] for name in names}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in ply.comments),
        f"element vertex {len(ply.rows)}",
        *(f"property {NAMES[types[name]]} {name}" for name in names),
        "end_header",
    ]
    packed = np.dtype([(name, "<" + types[name]) for name in names])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write("".join(line + "\n" for line in lines).encode())
        file.write(ply.rows.astype(packed).tobytes())


def columns(ply: Ply, names: Sequence[str], *, where: object) -> Shaped[np.ndarray, "n m"]:
    """Some properties as the columns of one array.

    Raises:
        CaptureError: The file lacks one of them.
    """
    present = ply.rows.dtype.names or ()
    if missing := [name for name in names if name not in present]:
        raise CaptureError(
            f"vertices have no {', '.join(missing[:4])}",
            where=where,
            got=", ".join(present[:12]) + (", ..." if len(present) > 12 else ""),
            do="write these properties",
        )
    if not names:
        return np.zeros((len(ply.rows), 0), np.float32)
    return np.stack([ply.rows[name] for name in names], -1)


def _header(file: BinaryIO, path: Path) -> _Header:
    lines = _header_lines(file, path)
    kind, count, properties, comments, element = "", -1, [], [], ""
    for words in (line.split() for line in lines):
        match words:
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as kind, _]:
                pass
            case ["comment", *words_of_comment]:
                comments.append(" ".join(words_of_comment))
            case ["obj_info", *_]:
                pass
            case ["element", name, number] if number.isdecimal() and (element or name == "vertex"):
                count, element = (int(number), name) if not element else (count, name)
            case ["property", "list", *_] if element != "vertex":
                pass
            case ["property", kind_of_number, name] if kind_of_number in TYPES:
                if element == "vertex":
                    properties.append((name, TYPES[kind_of_number]))
            case _:
                raise _unknown(path, " ".join(words))
    if not kind or count < 0 or not properties:
        raise _unknown(path, "no format" if not kind else "no vertices")
    if len({name for name, _ in properties}) < len(properties):
        raise _unknown(path, "a property twice")
    return _Header(kind, count, properties, tuple(comments))


def _header_lines(file: BinaryIO, path: Path) -> list[str]:
    if file.readline(8).strip() != b"ply":
        raise CaptureError("not a PLY file", where=path, do="give a .ply file")
    lines: list[str] = []
    while file.tell() < LONGEST_HEADER:
        line = file.readline(LONGEST_HEADER)
        if line.strip() == b"end_header":
            return lines
        if not line:
            break
        if line.strip():
            lines.append(line.decode("utf-8", errors="replace"))
    raise CaptureError("the header of a PLY file has no end", where=path, do="write it again")


def _from_text(
    file: BinaryIO, header: _Header, row: np.dtype, path: Path
) -> Shaped[np.ndarray, "n"]:
    lines = [line.split() for _, line in zip(range(header.count), file, strict=False)]
    if len(lines) < header.count:
        raise _truncated(path, len(lines), header.count)
    rows = np.zeros(header.count, row)
    wanted = len(header.properties)
    try:
        table = np.array(lines, np.float64).reshape(header.count, wanted)
    except ValueError:
        odd = (b" ".join(line).decode(errors="replace") for line in lines if len(line) != wanted)
        raise CaptureError(
            "cannot read the numbers of a PLY file",
            where=path,
            got=next(odd, "no numbers"),
            do="write it again",
        ) from None
    for name, values in zip(row.names or (), table.T, strict=True):
        rows[name] = values
    return rows


def _unknown(path: Path, got: str) -> CaptureError:
    return CaptureError(
        "cannot read the header of a PLY file",
        where=path,
        got=got,
        do="the first element must be vertices, and each property a single number",
    )


def _truncated(path: Path, got: int, wanted: int) -> CaptureError:
    return CaptureError(
        "a PLY file ends too early",
        where=path,
        got=f"{got} of {wanted} vertices",
        do="copy or write it again",
    )
