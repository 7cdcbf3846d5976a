"""Look at a file, recognise its format, and open it. A new format is one line in `FORMATS`.

What a file begins with decides, and its name only where that says nothing. Where several formats
fit, or the file leaves open what only its owner can know (the unit of times, the size of the
sensor, which of several cameras), the error asks for it by the name of the option.
"""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.recordings.aedat.aedat2 import open_aedat2
from sharpfield.recordings.aedat.aedat3 import open_aedat3
from sharpfield.recordings.aedat.aedat4 import open_aedat4
from sharpfield.recordings.prophesee.dat import open_dat
from sharpfield.recordings.prophesee.evt import open_evt
from sharpfield.recordings.recording import Recording
from sharpfield.recordings.ros.recording import open_rosbag
from sharpfield.recordings.tables.hdf5 import open_hdf5
from sharpfield.recordings.tables.npz import open_nmnist, open_npy, open_npz, open_npz_folder
from sharpfield.recordings.tables.text import open_text
from sharpfield.recordings.video import open_images, open_video
from sharpfield.storage.images import list_images

HEAD = 4096
"""Bytes that are looked at."""

TEXTS = (".txt", ".csv")

Recognise = Callable[[Path, bytes], bool]
"""Takes the path and what the file begins with, which is nothing for a folder."""


@dataclass(frozen=True)
class Format:
    """A kind of file that cameras and programs write."""

    recognise: Recognise
    """Whether the content says that it is one."""
    open: Callable[..., Recording]
    holds: str
    """What is read of it."""
    marks: str
    """By what it is recognised, in words."""
    suffixes: tuple[str, ...] = ()
    """Of files whose content says nothing."""
    takes: tuple[str, ...] = ("size",)
    """What it can be told besides, see `ReaderOptions`."""


@dataclass(frozen=True)
class ReaderOptions:
    """What the owner of a recording knows and its file does not say; None leaves it to the file."""

    unit: str | None = None
    """Of the stored times: ns, us, ms or s."""
    size: tuple[int, int] | None = None
    """Width and height of the event sensor in pixels."""
    topic: str | None = None
    """Which of several cameras, streams or topics of events."""
    image_topic: str | None = None
    """Which of several topics, or cameras, of images."""
    columns: str | None = None
    """What the columns of a table are, in their order, like "xytp"."""
    encoding: str | None = None
    """Of Prophesee's RAW: evt2, evt2.1, evt2.1-legacy or evt3."""
    per_second: float | None = None
    """How many frames were taken per second."""
    times: Path | None = None
    """The text that says when images were taken."""

    def given(self) -> dict[str, Any]:
        """What was not left to the file."""
        return {name: value for name, value in vars(self).items() if value is not None}


NOTHING = ReaderOptions()


def open_recording(
    path: Path | str, told: ReaderOptions = NOTHING, *, layout: str | None = None
) -> Recording:
    """Open what a camera, or a program in its place, has written.

    Args:
        path: A file or a folder.
        told: What the file does not say.
        layout: One of `FORMATS`; by default it is recognised.

    Raises:
        CaptureError: It is missing, of no known format, damaged, or leaves something open.
        OptionError: Something was told that does not belong to the format.
    """
    path = Path(path)
    name = layout or format_of(path)
    if name not in FORMATS:
        raise OptionError("unknown format", got=name, do=f"use one of {', '.join(FORMATS)}")
    for option in told.given().keys() - set(FORMATS[name].takes):
        able = [other for other, known in FORMATS.items() if option in known.takes]
        raise OptionError(
            f"the format {name} has no option {option}",
            where=path,
            do=f"it belongs to {', '.join(able)}",
        )
    return FORMATS[name].open(path, **told.given())


def open_events(
    path: Path | str, *, unit: str | None = None, sensor: tuple[int, int] | None = None
) -> Recording:
    """Open a recording for its events; see `open_recording`.

    Args:
        path: A file or a folder.
        unit: Of the stored times (ns, us, ms, s), where the file does not say.
        sensor: Width and height in pixels, where the file does not say.

    Raises:
        CaptureError: See `open_recording`; or it holds no events.
    """
    opened = open_recording(path, ReaderOptions(unit=unit, size=sensor))
    if opened.events is None:
        raise CaptureError("the recording holds no events", where=path, got=opened.layout)
    return opened


def format_of(path: Path) -> str:
    """The name of a file's format.

    Raises:
        CaptureError: There is no such file, or none or several formats fit.
    """
    if not path.exists():
        raise CaptureError("recording not found", where=path)
    if path.is_dir():
        head = b""
    else:
        with path.open("rb") as file:
            head = file.read(HEAD)
    fitting = [name for name, known in FORMATS.items() if known.recognise(path, head)]
    if not fitting and path.is_file():
        fitting = [n for n, known in FORMATS.items() if path.suffix.lower() in known.suffixes]
    if len(fitting) == 1:
        return fitting[0]
    marks = "; ".join(f"{known.marks} ({name})" for name, known in FORMATS.items())
    if path.is_dir():
        got = ", ".join(sorted(entry.name for entry in path.iterdir())[:8]) or "an empty folder"
    else:
        got = f"{path.stat().st_size} bytes, beginning with {head[:16]!r}"
    if fitting:
        raise CaptureError(
            "several formats fit",
            where=path,
            got=", ".join(fitting),
            do=f"choose a layout: {', '.join(fitting)}",
        )
    raise CaptureError("no known format", where=path, got=got, do=f"known are {marks}")


def _begins(*magics: bytes) -> Recognise:
    return lambda path, head: any(head.startswith(magic) for magic in magics)


def _is_evt(path: Path, head: bytes) -> bool:
    lines = [line[1:].lower().split() for line in head.split(b"\n") if line.startswith(b"%")]
    words = [(*line, b"", b"")[:2] for line in lines]
    return any(key == b"evt" or (key == b"format" and to.startswith(b"evt")) for key, to in words)


def _is_dat(path: Path, head: bytes) -> bool:
    other = path.suffix.lower() in (".raw", *TEXTS)
    return head.startswith(b"%") and not _is_evt(path, head) and not other


def _is_bag(path: Path, head: bytes) -> bool:
    magics = (b"#ROSBAG V2.0", b"SQLite format 3\x00", b"\x89MCAP0\r\n")
    return head.startswith(magics) or (path / "metadata.yaml").is_file()


def _zipped(path: Path, head: bytes, suffix: str) -> bool:
    """Whether a zip archive has a member of some name."""
    if not head.startswith(b"PK\x03\x04"):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(suffix) for name in archive.namelist())
    except (zipfile.BadZipFile, OSError, NotImplementedError):
        return False


def _is_video(path: Path, head: bytes) -> bool:
    riff = head.startswith(b"RIFF") and head[8:11] == b"AVI"
    return riff or head[4:8] == b"ftyp" or head.startswith(b"\x1aE\xdf\xa3")


def _has_images(path: Path, head: bytes) -> bool:
    if not path.is_dir() or any(
        (path / name).is_file() for name in ("events.txt", "metadata.yaml")
    ):
        return False
    return (path / "images.txt").is_file() or bool(list_images(path))


def _open_rpg(
    path: Path,
    *,
    size: tuple[int, int] | None = None,
    unit: str | None = None,
    columns: str | None = None,
) -> Recording:
    """A folder of RPG's data set: `events.txt`, and `images.txt` with the images it names."""
    events = open_text(path / "events.txt", size=size, unit=unit, columns=columns)
    if not (path / "images.txt").is_file():
        return replace(events, path=path)
    images = open_images(path)
    return replace(events, path=path, frames=images.frames)


FORMATS: dict[str, Format] = {
    "evt": Format(
        _is_evt,
        open_evt,
        "events, triggers",
        "a header with `% evt`",
        (".raw",),
        takes=("size", "encoding"),
    ),
    "dat": Format(_is_dat, open_dat, "events", "a header with `%` and no `% evt`", (".dat",)),
    "aedat2": Format(
        _begins(b"#!AER-DAT2", b"#!AER-DAT1"),
        open_aedat2,
        "events, frames of DAVIS with exposures, triggers",
        "`#!AER-DAT2`",
        (".aedat",),
    ),
    "aedat3": Format(
        _begins(b"#!AER-DAT3"),
        open_aedat3,
        "events, frames with exposures, triggers",
        "`#!AER-DAT3`",
        takes=("size", "topic"),
    ),
    "aedat4": Format(
        _begins(b"#!AER-DAT4"),
        open_aedat4,
        "events, frames with exposures, triggers",
        "`#!AER-DAT4`",
        takes=("size", "topic"),
    ),
    "rosbag": Format(
        _is_bag,
        open_rosbag,
        "events, images, triggers",
        "a bag of ROS 1, or of ROS 2 (SQLite, MCAP)",
        (".bag", ".db3", ".mcap"),
        takes=("size", "topic", "image_topic"),
    ),
    "nmnist": Format(
        lambda path, head: False, open_nmnist, "events", "the name FILE.bin", (".bin",)
    ),
    "text": Format(
        lambda path, head: _zipped(path, head, ".txt"),
        open_text,
        "events",
        "a zip of events.txt",
        TEXTS,
        takes=("size", "unit", "columns"),
    ),
    "rpg-folder": Format(
        lambda path, head: (path / "events.txt").is_file(),
        _open_rpg,
        "events, frames",
        "a folder with events.txt",
        takes=("size", "unit", "columns"),
    ),
    "hdf5": Format(
        _begins(b"\x89HDF\r\n\x1a\n"),
        open_hdf5,
        "events; frames of M3ED, MVSEC and event_utils",
        "HDF5",
        takes=("size", "unit", "topic", "image_topic"),
    ),
    "npz": Format(
        lambda path, head: _zipped(path, head, ".npy"),
        open_npz,
        "events",
        "npz",
        takes=("size", "unit"),
    ),
    "npz-folder": Format(
        lambda path, head: path.is_dir() and any(path.glob("*.npz")) and not list_images(path),
        open_npz_folder,
        "events",
        "a folder of npz",
        takes=("size", "unit"),
    ),
    "npy": Format(
        _begins(b"\x93NUMPY"), open_npy, "events", "npy", takes=("size", "unit", "columns")
    ),
    "video": Format(
        _is_video,
        open_video,
        "frames",
        "mp4, avi, mkv",
        (".mp4", ".avi", ".mov", ".mkv", ".webm"),
        takes=("per_second",),
    ),
    "images": Format(
        _has_images,
        open_images,
        "frames",
        "a folder of PNG or JPEG",
        takes=("unit", "per_second", "times"),
    ),
}
"""Every format, by name."""
