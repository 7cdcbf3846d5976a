"""Header of Prophesee's files: text lines of `% keyword value`.

The header ends at the first line that does not begin with `%`, or after `% end`. Older files give
neither the sensor resolution nor the encoding in full; the camera model then decides, by the name
of its plug-in or its number. Programs differ in capitals, in spaces, and in how they write a
resolution; all variants are read.

Source: Prophesee, *RAW file format* and *DAT file format* (Metavision documentation).
"""

import re
from dataclasses import dataclass
from pathlib import Path

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import read_head

MAX_LINE, MAX_HEADER = 1024, 2**16
"""Most bytes of a line and of a header."""

GEOMETRY = r"([0-9]{1,5}) *[xX,*] *([0-9]{1,5})"
"""How programs write a resolution."""

SIZES = {
    "genx320": (320, 320),
    "imx637": (640, 512),
    "imx647": (640, 512),
    "imx636": (1280, 720),
    "imx646": (1280, 720),
    "gen4": (1280, 720),
    "gen3": (640, 480),
}
"""Width and height by a part of the plug-in name."""

SYSTEMS = {
    **dict.fromkeys((21, 23, 25, 28, 29, 33, 34, 35, 40, 41), (640, 480)),
    **dict.fromkeys((26, 30, 31, 32, 39, 46, 48, 49, 50, 53, 58), (1280, 720)),
    **dict.fromkeys((52, 54), (640, 512)),
    64: (320, 320),
}
"""Width and height by `system_ID`, for cameras made by Prophesee."""


def names_evt(head: bytes) -> bool:
    """Whether a header says that a file is RAW: `% evt 3.0`, or `% format EVT3;...`."""
    lines = [line[1:].lower().split() for line in head.split(b"\n") if line.startswith(b"%")]
    words = [(*line, b"", b"")[:2] for line in lines]
    return any(key == b"evt" or (key == b"format" and to.startswith(b"evt")) for key, to in words)


@dataclass(frozen=True)
class Header:
    """A parsed header."""

    fields: dict[str, str]
    """Values by keyword in small letters."""
    length: int
    """Bytes of the header; the data begin there."""

    def number(self, *names: str) -> int | None:
        """The first of these fields that is a whole number or begins with one, as "2.0" does."""
        for name in names:
            if match := re.fullmatch(r"(-?[0-9]{1,18})(\.[0-9]*)?", self.fields.get(name, "")):
                return int(match[1])
        return None

    @property
    def format(self) -> dict[str, str]:
        """The parts of the field `format`, e.g. {"": "EVT3", "height": "720", "width": "1280"}."""
        name, *options = self.fields.get("format", "").split(";")
        pairs = [option.partition("=") for option in options]
        return {"": name.strip()} | {key.strip().lower(): value.strip() for key, _, value in pairs}


def read_header(path: Path) -> Header:
    """Read the header of a file; without a header there are no fields.

    Raises:
        CaptureError: The file cannot be read.
    """
    data = read_head(path, MAX_HEADER)
    fields: dict[str, str] = {}
    at = 0
    while data[at : at + 1] == b"%":
        stop = data.find(b"\n", at, at + MAX_LINE)
        if stop < 0 and len(data) < MAX_HEADER:
            stop = len(data)  # the header is all there is, and its last line is not terminated
        line = _text(data[at + 1 : stop]) if stop >= 0 else None
        if line is None:
            break
        at = min(stop + 1, len(data))
        keyword, value = [*line.split(maxsplit=1), "", ""][:2]
        if keyword.lower() == "end":
            break
        fields.setdefault(keyword.lower(), value.strip())
    return Header(fields, at)


def header_size(
    header: Header, path: Path, given: tuple[int, int] | None
) -> tuple[int, int] | None:
    """Resolution from the header, or from the camera model that it names; None if unknown.

    Args:
        header: Header of the file.
        path: The file, for the message.
        given: Resolution from the caller: it decides where the header only names a camera model,
            or gives several resolutions.

    Raises:
        CaptureError: The header contradicts itself.
    """
    found = set()
    if match := re.fullmatch(GEOMETRY, header.fields.get("geometry", "")):
        found.add((int(match[1]), int(match[2])))
    for known in (Header(header.format, 0), header):
        width, height = (known.number(name) for name in ("width", "height"))
        if width and height:
            found.add((width, height))
    if given in found:
        return given
    if len(found) > 1:
        raise CaptureError(
            "the header gives more than one size of the sensor",
            where=path,
            got=" and ".join(f"{width} x {height}" for width, height in sorted(found)),
            do="give the size that is right",
        )
    return next(iter(found), None) or given or _size_of_camera(header)


def _size_of_camera(header: Header) -> tuple[int, int] | None:
    plugin = header.fields.get("plugin_name", "").lower()
    for part, size in SIZES.items():
        if part in plugin:
            return size
    maker = header.fields.get("integrator_name", "Prophesee")
    number = header.number("system_id")
    return SYSTEMS.get(number & 0x7F) if number and maker == "Prophesee" and not plugin else None


def _text(line: bytes) -> str | None:
    """The text of a line; None for binary data, which holds unprintable bytes."""
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:
        text = line.decode("latin-1")
    text = text.rstrip("\r").replace("\t", " ")
    return text if text.isprintable() else None
