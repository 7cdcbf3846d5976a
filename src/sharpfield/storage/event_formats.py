"""Writing events in the format given by the suffix of a file name, chunk by chunk.

    .h5     our own, see `storage.event_writer`: it states its units and sensor resolution
    .npz    arrays x, y, t (us), p (-1 or +1) at the root, and tick_ns (1000), width, height
    .csv    a header `t_us,x,y,p`, then one event per line; p is -1 or +1
    .raw    Prophesee's EVT3, see `storage.evt_writer`

In every format the file appears whole, at the end, or not at all, and one chunk is in memory.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sharpfield.core.errors import OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.files import replacing
from sharpfield.storage.arrays import Column, write_arrays
from sharpfield.storage.event_writer import writing_events
from sharpfield.storage.evt_writer import writing_evt

Append = Callable[[EventStream], None]
"""Appends events that are later than all earlier ones."""


@contextmanager
def exporting_events(path: Path, like: EventStream) -> Iterator[Append]:
    """A function that appends events to a new file.

    Args:
        path: Ends in .h5, .npz, .csv or .raw.
        like: Any stream of the same sensor; it may be empty.

    Raises:
        OptionError: The name has another suffix.
    """
    expect_format(path)
    with FORMATS[path.suffix](path, like) as append:
        yield append


def expect_format(path: Path) -> None:
    """Check that the suffix of a file name is a format of events.

    Raises:
        OptionError: It is not.
    """
    if path.suffix not in FORMATS:
        raise OptionError(
            "unknown format of events", got=path, do=f"name a file with {', '.join(FORMATS)}"
        )


@contextmanager
def _native(path: Path, like: EventStream) -> Iterator[Append]:
    with writing_events(path, like) as writer:
        yield writer.append


@contextmanager
def _arrays(path: Path, like: EventStream) -> Iterator[Append]:
    about = {"tick_ns": 1000, "width": like.width, "height": like.height}
    with replacing(path) as temporary, TemporaryDirectory(dir=path.parent, prefix=".") as folder:
        columns = {name: Column(Path(folder) / name) for name in ("x", "y", "t", "p")}

        def append(events: EventStream) -> None:
            for name, column in columns.items():
                column.append(getattr(events, "t_us" if name == "t" else name))

        append(like[:0])
        yield append
        numbers = {name: np.array(value) for name, value in about.items()}
        write_arrays(temporary, columns | numbers)


@contextmanager
def _text(path: Path, like: EventStream) -> Iterator[Append]:
    with replacing(path) as temporary, temporary.open("w") as file:
        file.write("t_us,x,y,p\n")

        def append(events: EventStream) -> None:
            rows = np.stack([events.t_us, events.x, events.y, events.p], -1)
            np.savetxt(file, rows, "%d", delimiter=",")

        yield append


@contextmanager
def _raw(path: Path, like: EventStream) -> Iterator[Append]:
    with writing_evt(path, like) as writer:
        yield writer.append


FORMATS = {".h5": _native, ".npz": _arrays, ".csv": _text, ".raw": _raw}
