"""Text files with one event per line: RPG's events.txt, plain or zipped, v2e's text, and CSV.

    t x y p     in this order unless a header line names the columns; t in seconds
    # ...       comments, also with %
    240 180     a first line of two numbers is the sensor resolution (E2VID)
    %geometry:1280,720          so is this (Prophesee)
    t_us,x,y,p  a header line, as our own tables have

Times with a decimal point are seconds. Whole numbers may be of any unit, so it must be given,
unless the header line names it (t_s, t_ms, t_us, t_ns).

Source: Mueggler et al., *The event-camera dataset and simulator* (IJRR 2017); Hu et al., *v2e*
(CVPRW 2021); Rebecq et al., *E2VID* (TPAMI 2021).
"""

import re
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.recordings.bytes import BLOCK, ZIP, read_blocks, read_head, zip_holds
from sharpfield.recordings.chunks import CHUNK, RawChunk, ReorderBuffer, merge_chunks, resolve_size
from sharpfield.recordings.recording import (
    NO_OPTIONS,
    Chunks,
    Format,
    ReaderOptions,
    ReadLog,
    Recording,
)
from sharpfield.recordings.tables.text_decode import (
    EVENTS,
    FIRST_INVALID,
    INVALID,
    LINES,
    MINUSES,
    STATE_SIZE,
    ZEROS,
    decode_lines,
)
from sharpfield.recordings.video import open_images
from sharpfield.storage.arrays import UNREADABLE
from sharpfield.storage.event_columns import UNITS, known_unit

DEFAULT_COLUMNS = "txyp"
"""Order of the columns without a header line."""

POWERS = {"s": 6, "ms": 3, "us": 0, "ns": -3}
"""Power of ten that converts a unit to us."""

NAMES = {
    **dict.fromkeys(("timestamp", "time", "ts", "t"), "t"),
    **dict.fromkeys(("polarity", "pol", "p"), "p"),
    "x": "x",
    "y": "y",
}
"""Column by its name in header lines."""

SIZE = re.compile(r"[#%] *geometry *[:=]? *([0-9]{1,5}) *[xX,] *([0-9]{1,5})")
"""A comment that gives the sensor resolution."""

NAME = re.compile(rf"(?P<name>{'|'.join(NAMES)})[_\[(]*(?P<unit>s|ms|us|ns)?[\])]?")

MAX_HEADER, MAX_LINE = 2**16, 2**12
"""Most bytes of the lines before the first event, and of a line."""

MAX_INVALID_LINES, MAX_INVALID_SHARE = 100, 0.01
"""More invalid lines than this, and than this share of all, mean that the file holds no events."""

UNREADABLE_ZIP = (*UNREADABLE, struct.error, KeyError)
"""Errors of an archive that is damaged, encrypted or compressed in an unknown way."""


@dataclass(frozen=True)
class TextHeader:
    """Content of the lines before the first event."""

    length: int = 0
    """Bytes before the first line that the event parser can read."""
    size: tuple[int, int] | None = None
    columns: str = ""
    unit: str = ""


def open_text(path: Path | str, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a text file of events, or a zip archive that holds one.

    Args:
        path: The file.
        options: `size` and `unit`, where the text does not give them; `columns`, their order, where
            the text does not name them.

    Raises:
        CaptureError: The file holds no such text, or its resolution or unit is unknown.
        OptionError: The unit or the order of the columns is unknown.
    """
    path, columns = Path(path), options.columns
    log = ReadLog()
    read = _zipped(path) if read_head(path, 4) == ZIP else lambda pass_log: read_blocks(path)
    start = next(read(ReadLog()), b"")
    header = _header(start[:MAX_HEADER])
    order = header.columns or columns or DEFAULT_COLUMNS
    if sorted(order) != sorted(DEFAULT_COLUMNS):
        raise OptionError("columns are t, x, y and p in some order", got=order, do="e.g. xytp")
    if columns and header.columns and columns != header.columns:
        raise CaptureError(
            "the columns given are not those in the file",
            where=path,
            got=f"{columns} given, {header.columns} in the file",
            do="leave the columns out",
        )
    time = _first(start[header.length : MAX_HEADER], order.index("t"))
    unit = known_unit(options.unit) if options.unit else header.unit or _unit(time, path)
    size = resolve_size(header.size, options.size, path)
    layout = np.array([*(order.index(name) for name in DEFAULT_COLUMNS), POWERS[unit]], np.int64)

    def events() -> Chunks:
        pass_log = log.start("events")
        raw_chunks = _raw_chunks(_from(header.length, read(pass_log)), layout, path, pass_log)
        return merge_chunks(raw_chunks, size, where=path, log=pass_log)

    return Recording(path, "text", size=size, events=events, log=log)


def open_rpg_folder(path: Path, options: ReaderOptions = NO_OPTIONS) -> Recording:
    """Open a folder of RPG's data set: `events.txt`, and `images.txt` with the images it lists.

    Raises:
        CaptureError: See `open_text` and `video.open_images`.
    """
    events = open_text(path / "events.txt", options)
    listed = (path / "images.txt").is_file()
    return replace(events, path=path, frames=open_images(path).frames if listed else None)


def _header(text: bytes) -> TextHeader:
    """Parse the lines before the first event."""
    at, header = (3 if text.startswith(b"\xef\xbb\xbf") else 0), TextHeader()
    while (stop := text.find(b"\n", at)) >= 0:
        line = text[at:stop].decode("latin-1").strip()
        words = re.split(r"[\s,;]+", line)
        if sized := SIZE.fullmatch(line):
            header = replace(header, size=(int(sized[1]), int(sized[2])))
        elif len(words) == 2 and all(re.fullmatch("[0-9]{1,5}", word) for word in words):
            header = replace(header, length=stop + 1, size=(int(words[0]), int(words[1])))
        elif words[0][:1] not in ("", "#", "%"):
            named = [NAME.fullmatch(word.lower()) for word in words]
            order = "".join(NAMES[match["name"]] if match else "?" for match in named)
            if sorted(order) != sorted(DEFAULT_COLUMNS):
                break
            unit = "".join(match["unit"] or "" for match in named if match)
            header = replace(header, length=stop + 1, columns=order, unit=unit)
        at = stop + 1
    return header


def _first(text: bytes, column: int) -> str:
    """Time of the first event as text; empty if there is none."""
    for line in text.decode("latin-1").splitlines():
        words = re.split(r"[\s,;]+", line.strip())
        if words[0][:1] not in ("", "#", "%") and len(words) > column:
            return words[column]
    return ""


def _unit(time: str, path: Path) -> str:
    if not time or re.search("[.eE]", time):
        return "s"
    raise CaptureError(
        "the text does not state the unit of its times",
        where=path,
        got=f"the first is {time}",
        do=f"give the unit: one of {', '.join(UNITS)}",
    )


def _raw_chunks(
    data: Iterator[bytes], layout: np.ndarray, path: Path, log: ReadLog
) -> Iterator[RawChunk]:
    buffer, state = ReorderBuffer(), np.zeros(STATE_SIZE, np.int64)
    rest, invalid = b"", 0
    for block in chain(data, [None]):
        rest += b"\n" if block is None else block
        while True:
            text = np.frombuffer(rest, np.uint8)
            used, buffer.end = decode_lines(text, state, layout, buffer.columns, buffer.end)
            rest = rest[used:]
            _expect_events(state, path)
            log.note("lines that could not be read", int(state[INVALID]) - invalid)
            invalid = int(state[INVALID])
            if buffer.end < CHUNK:
                break
            yield buffer.flush(last=False)
        if len(rest) > MAX_LINE:
            rest = b""
            state[INVALID] += 1
    yield buffer.flush(last=True)


def _expect_events(state: np.ndarray, path: Path) -> None:
    """Check that most lines are events, and that polarity has two values."""
    invalid, events, lines = (int(state[i]) for i in (INVALID, EVENTS, LINES))
    if invalid > max(MAX_INVALID_LINES, MAX_INVALID_SHARE * lines) or (invalid and not events):
        raise CaptureError(
            "lines are no events of four numbers: time, column, row and polarity",
            where=f"{path}, line {state[FIRST_INVALID]}",
            got=f"{invalid} of {lines} lines are none",
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
    """Blocks without the first `start` bytes."""
    for block in data:
        yield block[start:]
        start = max(start - len(block), 0)


def _zipped(path: Path) -> Callable[[ReadLog], Iterator[bytes]]:
    """Find the text of events in a zip archive.

    Returns:
        Function that reads it from the beginning, and counts damage in the log.

    Raises:
        CaptureError: There is none or more than one, or it cannot be decompressed.
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
    except UNREADABLE_ZIP as error:
        raise CaptureError(
            "cannot read the archive", where=path, got=error, do="copy or pack it again"
        ) from None

    def read(pass_log: ReadLog) -> Iterator[bytes]:
        try:
            with zipfile.ZipFile(path) as archive, archive.open(named[0]) as file:
                while block := file.read(BLOCK):
                    yield block
        except UNREADABLE_ZIP:
            pass_log.note("damaged archives, read up to the damage")

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
