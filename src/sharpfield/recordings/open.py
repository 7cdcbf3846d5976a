"""Open a recording of any known format.

The content of a file decides its format, and its name only where the content is not distinctive.
Where several formats match, or the file leaves something open that only the user can know (unit of
times, sensor resolution, which of several cameras), the error names the option to give.
"""

from pathlib import Path

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.plugins import Registry
from sharpfield.recordings.recording import NO_OPTIONS, Format, ReaderOptions, Recording

HEAD_BYTES = 4096
"""Number of bytes by which a file is recognised."""

FORMATS = Registry(
    "sharpfield.formats",
    {
        "evt": "sharpfield.recordings.prophesee.evt:FORMAT",
        "dat": "sharpfield.recordings.prophesee.dat:FORMAT",
        "aedat2": "sharpfield.recordings.aedat.aedat2:FORMAT",
        "aedat3": "sharpfield.recordings.aedat.aedat3:FORMAT",
        "aedat4": "sharpfield.recordings.aedat.aedat4:FORMAT",
        "rosbag": "sharpfield.recordings.ros.recording:FORMAT",
        "nmnist": "sharpfield.recordings.tables.npz:NMNIST",
        "text": "sharpfield.recordings.tables.text:FORMAT",
        "rpg-folder": "sharpfield.recordings.tables.text:RPG_FOLDER",
        "hdf5": "sharpfield.recordings.tables.columns:FORMAT",
        "npz": "sharpfield.recordings.tables.npz:NPZ",
        "npz-folder": "sharpfield.recordings.tables.npz:NPZ_FOLDER",
        "npy": "sharpfield.recordings.tables.npz:NPY",
        "video": "sharpfield.recordings.video:VIDEO",
        "images": "sharpfield.recordings.video:IMAGES",
    },
)
"""Every file format, by name; each reader is imported when it is first asked for."""


def open_recording(
    path: Path | str, options: ReaderOptions = NO_OPTIONS, *, layout: str | None = None
) -> Recording:
    """Open what a camera or a program has written; events and frames are read when asked for.

    Args:
        path: A file or a folder.
        options: What the file does not say.
        layout: Name of the format, one of `FORMATS`; by default it is recognised.

    Raises:
        CaptureError: The file is missing, of no known format, damaged, or leaves something open.
        OptionError: An option does not belong to the format.
    """
    path = Path(path)
    known: Format = FORMATS.named(layout or format_of(path), "format")
    for option in sorted(options.given().keys() - set(known.options)):
        others = [one.name for one in FORMATS.working().values() if option in one.options]
        raise OptionError(
            f"the format {known.name} has no option {option}",
            where=path,
            do=f"it belongs to {', '.join(others)}",
        )
    return known.open(path, options)


def format_of(path: Path) -> str:
    """Name of the format of a file or folder.

    Raises:
        CaptureError: There is no such file, or no format matches, or several do.
    """
    if not path.exists():
        raise CaptureError("recording not found", where=path)
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    formats = FORMATS.working()
    matches = [name for name, known in formats.items() if known.recognise(path, head)]
    if not matches and path.is_file():
        suffix = path.suffix.lower()
        matches = [name for name, known in formats.items() if suffix in known.suffixes]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise CaptureError(
            "several formats fit",
            where=path,
            got=", ".join(matches),
            do=f"choose a layout: {', '.join(matches)}",
        )
    if path.is_dir():
        got = ", ".join(sorted(entry.name for entry in path.iterdir())[:8]) or "an empty folder"
    else:
        got = f"{path.stat().st_size} bytes, beginning with {head[:16]!r}"
    marks = "; ".join(f"{known.marks} ({name})" for name, known in formats.items())
    raise CaptureError("no known format", where=path, got=got, do=f"known are {marks}")
