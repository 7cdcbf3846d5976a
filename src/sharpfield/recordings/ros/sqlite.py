"""Bags of ROS 2 in SQLite, the default of its first releases: tables of topics and messages.

Source: the schema of rosbag2's storage plug-in `sqlite3`.
"""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.bytes import Bytes, DamagedData, decompress, read_head
from sharpfield.recordings.recording import ReadLog
from sharpfield.recordings.ros.bag import Bag, Message, topic_of

MAGIC = b"SQLite format 3\0"
FAILURES = (sqlite3.Error, UnicodeDecodeError)
"""Errors of a damaged database; the second where not even the error text can be decoded."""

ZSTD = b"\x28\xb5\x2f\xfd"
"""Signature of a compressed message; others begin with 0."""


def open_sqlite_bag(path: Path) -> Bag:
    """Open a `.db3` file.

    Raises:
        CaptureError: The file is no bag of ROS 2.
    """
    if read_head(path, len(MAGIC)) != MAGIC:
        raise CaptureError("the file is no SQLite database", where=path)
    try:
        with closing(_connected(path)) as database:
            rows = database.execute("SELECT id, name, type FROM topics").fetchall()
    except FAILURES as error:
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
                        yield Message(numbers[number], int(logged_ns), _plain(data))
                    except (DamagedData, ValueError, TypeError, OverflowError):
                        log.note("damaged messages")
        except FAILURES:
            log.note("truncated ends of the file")

    return Bag(path, "ROS2 SQLite bag", topics, messages)


def _connected(path: Path) -> sqlite3.Connection:
    # Immutable: SQLite looks for no journal and writes nothing beside the file.
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    database.text_factory = lambda data: data.decode("utf-8", "replace")
    return database


def _plain(data: object) -> Bytes:
    if not isinstance(data, bytes):
        raise DamagedData("a message that is no bytes")
    return decompress(data, "zstd") if data.startswith(ZSTD) else data
