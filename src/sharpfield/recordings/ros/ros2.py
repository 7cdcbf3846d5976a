"""Bags of ROS 2: MCAP, its default, and SQLite, the default of its first releases.

MCAP is read from the front, so that truncated files are read, too. A *record* is a type, a length
and the content. A *chunk* holds other records, possibly compressed. A *schema* names a message
type, a *channel* maps a number to a topic and its schema. The summary at the end is used only to
find the channels. SQLite bags are tables of topics and messages.

Source: https://mcap.dev/spec; the schema of rosbag2's storage plug-in `sqlite3`.
"""

import sqlite3
import struct
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import MAX_BLOCK, Bytes, DamagedData, decompress, read_head
from sharpfield.recordings.recording import ReadLog
from sharpfield.recordings.ros.bag import (
    Bag,
    Connections,
    Message,
    ReadBytes,
    file_reader,
    memory_reader,
    topic_of,
)

MCAP_MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 2, 3, 4, 5, 6, 15
FOOTER_SIZE = 9 + 20 + len(MCAP_MAGIC)

Record = tuple[int, Bytes]


def open_mcap(path: Path) -> Bag:
    """Open a file.

    Raises:
        CaptureError: The file is no MCAP.
    """
    if read_head(path, len(MCAP_MAGIC)) != MCAP_MAGIC:
        raise CaptureError("the file is no MCAP", where=path)
    channels = _summarised(path) or _channels(_records(path, len(MCAP_MAGIC), ReadLog()))

    def messages(wanted: Collection[str], log: ReadLog) -> Iterator[Message]:
        numbers = {n: name for n, (name, _) in channels.items() if name in wanted}
        for kind, content in _records(path, len(MCAP_MAGIC), log):
            if kind == MESSAGE and len(content) >= 22:
                number, _, logged_ns = struct.unpack_from("<HIQ", content)
                if number in numbers:
                    yield Message(numbers[number], logged_ns, memoryview(content)[22:])

    return Bag(path, "ROS2 MCAP", dict(channels.values()), messages)


def _summarised(path: Path) -> Connections:
    """Channels from the summary; empty if there is no summary."""
    length = path.stat().st_size
    if length < len(MCAP_MAGIC) + FOOTER_SIZE:
        return {}
    with path.open("rb") as file:
        file.seek(length - FOOTER_SIZE)
        kind, _, start = struct.unpack("<BQQ", file.read(17))
    if kind != FOOTER or not len(MCAP_MAGIC) < start < length:
        return {}
    return _channels(_records(path, start, ReadLog()))


def _channels(records: Iterator[Record]) -> Connections:
    schemas: dict[int, str] = {}
    found: Connections = {}
    for kind, content in records:
        try:
            if kind == SCHEMA:
                number, content = _number(content, "H")
                schemas[number] = _text(content)[0]
            elif kind == CHANNEL:
                number, content = _number(content, "H")
                schema, content = _number(content, "H")
                name, content = _text(content)
                encoding, _ = _text(content)
                if encoding in ("cdr", "ros1"):
                    found[number] = name, topic_of(schemas.get(schema, ""), cdr=encoding == "cdr")
        except DamagedData:
            continue
    return found


def _records(path: Path, begin: int, log: ReadLog) -> Iterator[Record]:
    """Records outside and inside chunks, up to the end of the data or of the summary."""
    length = path.stat().st_size
    with path.open("rb") as file:
        try:
            for kind, content in _flat_records(file_reader(file), begin, length):
                if kind in (DATA_END, FOOTER):
                    return
                if kind != CHUNK:
                    yield kind, content
                    continue
                try:
                    data = _chunk(content)
                    yield from _flat_records(memory_reader(data), 0, len(data))
                except DamagedData:
                    log.note("damaged chunks")
            log.note("truncated ends of the file")
        except DamagedData:
            log.note("truncated ends of the file")


def _flat_records(read: ReadBytes, begin: int, end: int) -> Iterator[Record]:
    offset = begin
    while start := read(offset, 9):
        if len(start) < 9:
            raise DamagedData("a truncated record")
        kind, size = struct.unpack("<BQ", start)
        offset += 9
        if size > end - offset:
            if kind == CHUNK:
                # The last chunk of a truncated recording may be read in part.
                yield kind, read(offset, MAX_BLOCK)
            raise DamagedData("a truncated record")
        if kind in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
            if size > MAX_BLOCK:
                raise DamagedData(f"a record of {size} bytes")
            yield kind, read(offset, size)
        else:
            yield kind, b""
        offset += size


def _chunk(content: Bytes) -> Bytes:
    """Decompress a chunk; its times, decompressed size and checksum are not needed."""
    compression, content = _text(memoryview(content)[28:])
    size, content = _number(content, "Q")
    return decompress(content[:size], compression or "none")


def _number(data: Bytes, kind: str) -> tuple[int, Bytes]:
    size = struct.calcsize(f"<{kind}")
    if len(data) < size:
        raise DamagedData("a truncated record")
    return struct.unpack_from(f"<{kind}", data)[0], data[size:]


def _text(data: Bytes) -> tuple[str, Bytes]:
    length, data = _number(data, "I")
    if length > len(data):
        raise DamagedData("a truncated text")
    return bytes(data[:length]).decode("utf-8", "replace"), data[length:]


SQLITE_MAGIC = b"SQLite format 3\0"
SQLITE_ERRORS = (sqlite3.Error, UnicodeDecodeError)
"""Errors of a damaged database; the second where not even the error text can be decoded."""

ZSTD = b"\x28\xb5\x2f\xfd"
"""Signature of a compressed message; others begin with 0."""


def open_sqlite_bag(path: Path) -> Bag:
    """Open a `.db3` file.

    Raises:
        CaptureError: The file is no bag of ROS 2.
    """
    if read_head(path, len(SQLITE_MAGIC)) != SQLITE_MAGIC:
        raise CaptureError("the file is no SQLite database", where=path)
    try:
        with closing(_connected(path)) as database:
            rows = database.execute("SELECT id, name, type FROM topics").fetchall()
    except SQLITE_ERRORS as error:
        raise CaptureError("the file is no bag of ROS 2", where=path, got=error) from None
    topics = {str(name): topic_of(str(kind), cdr=True) for _, name, kind in rows}
    numbers = {number: str(name) for number, name, _ in rows}

    def messages(wanted: Collection[str], log: ReadLog) -> Iterator[Message]:
        chosen = [number for number, name in numbers.items() if name in wanted]
        marks = ", ".join("?" * len(chosen))
        # In recorded order: ordering by time would need an index, which is damaged more easily.
        query = (
            "SELECT topic_id, timestamp, data FROM messages"
            f" WHERE topic_id IN ({marks}) ORDER BY id"
        )
        try:
            with closing(_connected(path)) as database:
                for number, logged_ns, data in database.execute(query, chosen):
                    try:
                        yield Message(numbers[number], int(logged_ns), _payload(data))
                    except (DamagedData, ValueError, TypeError, OverflowError):
                        log.note("damaged messages")
        except SQLITE_ERRORS:
            log.note("truncated ends of the file")

    return Bag(path, "ROS2 SQLite bag", topics, messages)


def _connected(path: Path) -> sqlite3.Connection:
    # Immutable: SQLite looks for no journal and writes nothing beside the file.
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    database.text_factory = lambda data: data.decode("utf-8", "replace")
    return database


def _payload(data: object) -> Bytes:
    if not isinstance(data, bytes):
        raise DamagedData("a message that is no bytes")
    return decompress(data, "zstd") if data.startswith(ZSTD) else data
