"""PLY files, and 3D Gaussians in the `.ply` layout that splat viewers read.

A file holds one row of numbers for each vertex, with the property names of the header.
Reading supports `ascii`, `binary_little_endian` and `binary_big_endian`, with the vertices as first
element and without list properties; what follows (faces) is ignored. Files are written in binary,
little endian. A *row* is a numpy structure with a field for each property.

Source: Greg Turk, "The PLY polygon file format" (1994).

Vertices of Gaussians have the position `x y z`, an unused normal `nx ny nz`, spherical harmonics
(SH) of degree 0 `f_dc_0..2`, higher ones `f_rest_*` (all of red, then green, then blue), the logit
of the `opacity`, the natural log of the scales `scale_0..2` and a quaternion `rot_0..3` (w x y z).
The SH include the Condon-Shortley phase, so those of odd order m have the opposite sign of ours.
The colour of degree 0 is 0.5 + 0.282 f_dc.

Source: released code of "3D Gaussian splatting for real-time radiance field rendering" (SIGGRAPH
2023), which made this layout.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32, Shaped

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


POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
BASE = tuple(f"f_dc_{i}" for i in range(3))
SCALES = tuple(f"scale_{i}" for i in range(3))
ROTATION = tuple(f"rot_{i}" for i in range(4))

COUNTS = [3 * ((degree + 1) ** 2 - 1) for degree in range(4)]
"""Number of higher SH coefficients of three colours, for degrees 0 to 3."""


@dataclass(frozen=True)
class SplatTable:
    """Gaussians as in such files, but with our signs and order of SH coefficients."""

    means: Float32[np.ndarray, "n 3"]
    quaternions: Float32[np.ndarray, "n 4"]
    """w x y z."""
    log_scales: Float32[np.ndarray, "n 3"]
    opacity_logits: Float32[np.ndarray, "n"]
    harmonics: Float32[np.ndarray, "n k 3"]
    """Ordered by degree, then by order m from -l to l, see `ops/encoding.py`."""
    comments: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"SplatTable({len(self.means):,} Gaussians, {self.harmonics.shape[1]} harmonics)"


def write_splats(path: Path, splats: SplatTable) -> None:
    """Write Gaussians of SH degree 0 to 3; the file appears whole or not at all."""
    count, k, _ = splats.harmonics.shape
    harmonics = splats.harmonics * _signs(k)
    higher = harmonics[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (k - 1))
    values = np.concatenate(
        [
            splats.means,
            np.zeros_like(splats.means),
            harmonics[:, 0],
            higher,
            splats.opacity_logits[:, None],
            splats.log_scales,
            splats.quaternions,
        ],
        -1,
    )
    names = [*POSITION, *NORMAL, *BASE, *_higher(higher.shape[1]), "opacity", *SCALES, *ROTATION]
    rows = np.ascontiguousarray(values).view([(name, "f4") for name in names])[:, 0]
    write_ply(path, Ply(rows, splats.comments))


def read_splats(path: Path) -> SplatTable:
    """Read Gaussians.

    Raises:
        CaptureError: The file is missing or truncated, or does not hold Gaussians.
    """
    ply = read_ply(path)
    names = ply.rows.dtype.names or ()
    count = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    if count not in COUNTS:
        raise CaptureError(
            "unexpected number of SH coefficients",
            where=path,
            got=f"{count} properties f_rest_*",
            do=f"there must be {', '.join(map(str, COUNTS[:-1]))} or {COUNTS[-1]}, by degree",
        )

    def read(wanted: tuple[str, ...]) -> Float32[np.ndarray, "n m"]:
        values = columns(ply, wanted, where=path).astype(np.float32)
        if not np.isfinite(values).all():
            raise CaptureError(
                "Gaussians are not finite",
                where=path,
                got=f"in {', '.join(wanted[:3])}",
                do="export them again",
            )
        return values

    higher = read(_higher(count)).reshape(len(ply.rows), 3, count // 3).transpose(0, 2, 1)
    harmonics = np.concatenate([read(BASE)[:, None], higher], 1)
    return SplatTable(
        means=read(POSITION),
        quaternions=read(ROTATION),
        log_scales=read(SCALES),
        opacity_logits=read(("opacity",))[:, 0],
        harmonics=harmonics * _signs(harmonics.shape[1]),
        comments=ply.comments,
    )


def _higher(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _signs(count: int) -> Float32[np.ndarray, "k 1"]:
    """The Condon-Shortley phase of each harmonic: (-1)^m."""
    orders = [m for degree in range(math.isqrt(count)) for m in range(-degree, degree + 1)]
    return np.where(np.array(orders) % 2, -1, 1).astype(np.float32)[:, None]
