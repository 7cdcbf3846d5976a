"""Events as text, one per line: RPG's events.txt, plain or zipped, v2e's, and tables with commas.

    t x y p     in this order unless a line of names says otherwise; t in seconds
    # ...       remarks, also with %
    240 180     a first line of two numbers is the size of the sensor (E2VID)
    %geometry:1280,720          so is this (Prophesee)
    t_us,x,y,p  a line of names, as our own tables have

Times with a decimal point are seconds; whole ones may be anything, unless the line of names tells
(t_s, t_ms, t_us, t_ns), so the unit is asked for.

Source: Mueggler et al., *The event-camera dataset and simulator* (IJRR 2017); Hu et al., *v2e*
(CVPRW 2021); Rebecq et al., *E2VID* (TPAMI 2021).
"""

import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.recordings.bytes import BLOCK, ZIP, blocks, head, zip_holds
from sharpfield.recordings.chunks import CHUNK, RawChunk, Reorder, joined, known_size
from sharpfield.recordings.format import NO_OPTIONS, Format, ReaderOptions
from sharpfield.recordings.recording import Chunks, ReadLog, Recording
from sharpfield.recordings.tables.text_decode import (
    BAD,
    BAD_LINE,
    LINES,
    MINUSES,
    REMEMBERED,
    SEEN,
    ZEROS,
    decode_lines,
)
from sharpfield.recordings.video import open_images
from sharpfield.storage.event_columns import UNITS, known_unit

USUAL = "txyp"
"""Order of the columns where nothing else is said."""

POWERS = {"s": 6, "ms": 3, "us": 0, "ns": -3}
"""Powers of ten that make us of a unit."""

NAMES = {
    **dict.fromkeys(("timestamp", "time", "ts", "t"), "t"),
    **dict.fromkeys(("polarity", "pol", "p"), "p"),
    "x": "x",
    "y": "y",
}
"""Columns by what tables call them."""

SIZE = re.compile(r"[#%] *geometry *[:=]? *([0-9]{1,5}) *[xX,] *([0-9]{1,5})")
"""A remark that gives the size of the sensor."""

NAME = re.compile(rf"(?P<name>{'|'.join(NAMES)})[_\[(]*(?P<unit>s|ms|us|ns)?[\])]?")

WHOLE_HEAD, LONGEST = 2**16, 2**12
"""Most bytes of remarks at the beginning, and of a line."""

BAD_LINES, BAD_SHARE = 100, 0.01
"""More unreadable lines than this, and than this share of all, mean that it is no such text."""

UNREADABLE = (
    *(zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError),
    *(KeyError, ValueError, NotImplementedError, RuntimeError),
)
"""What an archive that is damaged, locked or packed in an odd way raises."""

Blocks = Callable[[ReadLog], Iterator[bytes]]
"""Starts reading the text anew, and notes what is damaged."""


@dataclass(frozen=True)
class Beginning:
    """What the lines before the first event say."""

    length: int = 0
    """Bytes up to the first event or remark that has to be read as such."""
    size: tuple[int, int] | None = None
    columns: str = ""
    unit: str = ""


def open_text(path: Path | str, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a text of events, or a zip archive that holds one.

    Args:
        path: Of the file.
        options: `size` and `unit`, where the text does not give them; `columns`, their order, where
            the text does not name them.

    Raises:
        CaptureError: It is no such file, or size or unit are not known.
        OptionError: There is no such unit, or no such order of columns.
    """
    path, columns = Path(path), options.columns
    trouble = ReadLog()
    read = _zipped(path) if head(path, 4) == ZIP else lambda noted: blocks(path)
    start = next(read(ReadLog()), b"")
    begin = _beginning(start[:WHOLE_HEAD])
    order = begin.columns or columns or USUAL
    if sorted(order) != sorted(USUAL):
        raise OptionError("columns are t, x, y and p in some order", got=order, do="e.g. xytp")
    if columns and begin.columns and columns != begin.columns:
        raise CaptureError(
            "the columns given are not those in the file",
            where=path,
            got=f"{columns} given, {begin.columns} in the file",
            do="leave the columns out",
        )
    time = _first(start[begin.length : WHOLE_HEAD], order.index("t"))
    unit = known_unit(options.unit) if options.unit else begin.unit or _unit(time, path)
    size = known_size(begin.size, options.size, path)
    layout = np.array([*(order.index(name) for name in USUAL), POWERS[unit]], np.int64)

    def events() -> Chunks:
        noted = trouble.anew("events")
        pieces = _pieces(_from(begin.length, read(noted)), layout, path, noted)
        return joined(pieces, size, where=path, trouble=noted)

    return Recording(path, "text", size=size, events=events, trouble=trouble)


def open_rpg_folder(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a folder of RPG's data set: `events.txt`, and `images.txt` with the images it lists.

    Raises:
        CaptureError: See `open_text` and `video.open_images`.
    """
    events = open_text(path / "events.txt", options)
    listed = (path / "images.txt").is_file()
    return replace(events, path=path, frames=open_images(path).frames if listed else None)


def _beginning(text: bytes) -> Beginning:
    """What comes before the first event."""
    at, found = (3 if text.startswith(b"\xef\xbb\xbf") else 0), Beginning()
    while (stop := text.find(b"\n", at)) >= 0:
        line = text[at:stop].decode("latin-1").strip()
        words = re.split(r"[\s,;]+", line)
        if sized := SIZE.fullmatch(line):
            found = replace(found, size=(int(sized[1]), int(sized[2])))
        elif len(words) == 2 and all(re.fullmatch("[0-9]{1,5}", word) for word in words):
            found = replace(found, length=stop + 1, size=(int(words[0]), int(words[1])))
        elif words[0][:1] not in ("", "#", "%"):
            named = [NAME.fullmatch(word.lower()) for word in words]
            order = "".join(NAMES[match["name"]] if match else "?" for match in named)
            if sorted(order) != sorted(USUAL):
                break
            unit = "".join(match["unit"] or "" for match in named if match)
            found = replace(found, length=stop + 1, columns=order, unit=unit)
        at = stop + 1
    return found


def _first(text: bytes, column: int) -> str:
    """The time of the first event; empty if there is none."""
    for line in text.decode("latin-1").splitlines():
        words = re.split(r"[\s,;]+", line.strip())
        if words[0][:1] not in ("", "#", "%") and len(words) > column:
            return words[column]
    return ""


def _unit(time: str, path: Path) -> str:
    if not time or re.search("[.eE]", time):
        return "s"
    raise CaptureError(
        "the text does not say the unit of its times",
        where=path,
        got=f"the first is {time}",
        do=f"give the unit: one of {', '.join(UNITS)}",
    )


def _pieces(
    data: Iterator[bytes], layout: np.ndarray, path: Path, trouble: ReadLog
) -> Iterator[RawChunk]:
    room, state = Reorder(), np.zeros(REMEMBERED, np.int64)
    rest, told = b"", 0
    for block in chain(data, [None]):
        rest += b"\n" if block is None else block
        while True:
            text = np.frombuffer(rest, np.uint8)
            used, room.end = decode_lines(text, state, layout, room.columns, room.end)
            rest = rest[used:]
            _expect_events(state, path)
            trouble.note("lines that could not be read", int(state[BAD]) - told)
            told = int(state[BAD])
            if room.end < CHUNK:
                break
            yield room.taken(last=False)
        if len(rest) > LONGEST:
            rest = b""
            state[BAD] += 1
    yield room.taken(last=True)


def _expect_events(state: np.ndarray, path: Path) -> None:
    """Make sure that most lines are events, and that polarities are of one kind."""
    bad, seen, lines = (int(state[place]) for place in (BAD, SEEN, LINES))
    if bad > max(BAD_LINES, BAD_SHARE * lines) or (bad and not seen):
        raise CaptureError(
            "lines are no events of four numbers: time, column, row and polarity",
            where=f"{path}, line {state[BAD_LINE]}",
            got=f"{bad} of {lines} lines are none",
            do="check which column is which; columns and rows are whole, polarity is 0, 1 or -1",
        )
    if state[ZEROS] and state[MINUSES]:
        raise CaptureError(
            "polarity takes three values",
            where=path,
            got="-1, 0 and 1",
            do="map darker events to -1 or to 0, not to both",
        )


def _from(start: int, data: Iterator[bytes]) -> Iterator[bytes]:
    """Blocks but for the first bytes."""
    for block in data:
        yield block[start:]
        start = max(start - len(block), 0)


def _zipped(path: Path) -> Blocks:
    """What reads the only text of an archive.

    Raises:
        CaptureError: There is none, or more than one, or it cannot be unpacked.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            texts = [name for name in archive.namelist() if name.endswith((".txt", ".csv"))]
            named = [name for name in texts if Path(name).stem == "events"] or texts
            if len(named) != 1:
                raise CaptureError(
                    "the archive must hold one text of events",
                    where=path,
                    got=", ".join(texts[:8]) or "no .txt or .csv",
                    do="name it events.txt, or unpack the archive",
                )
            archive.open(named[0]).close()
    except UNREADABLE as error:
        raise CaptureError(
            "cannot read the archive", where=path, got=error, do="copy or pack it again"
        ) from None

    def read(noted: ReadLog) -> Iterator[bytes]:
        try:
            with zipfile.ZipFile(path) as archive, archive.open(named[0]) as file:
                while block := file.read(BLOCK):
                    yield block
        except UNREADABLE:
            noted.note("damaged archives, read up to the damage")

    return read


FORMAT = Format(
    "text",
    open_text,
    holds="events",
    marks="a zip of events.txt",
    recognise=lambda path, head: zip_holds(path, head, ".txt"),
    suffixes=(".txt", ".csv"),
    options=("size", "unit", "columns"),
)
RPG_FOLDER = Format(
    "rpg-folder",
    open_rpg_folder,
    holds="events, frames",
    marks="a folder with events.txt",
    recognise=lambda path, head: (path / "events.txt").is_file(),
    options=("size", "unit", "columns"),
)
