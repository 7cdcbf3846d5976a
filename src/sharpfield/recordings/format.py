"""What a file format is: how it is recognised, how it is opened, and which options it takes.

Each reader defines one `FORMAT`; `recordings.open.FORMATS` lists them. Another package adds one by
an entry point in its `pyproject.toml`:

    [project.entry-points."sharpfield.formats"]
    my-camera = "my_package.my_camera:FORMAT"
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sharpfield.recordings.recording import Recording


@dataclass(frozen=True)
class ReaderOptions:
    """What the user knows about a recording and its file does not say; None leaves it to the file.

    A new option is a field here, and its name in the `Format.options` of the readers that use it.
    """

    unit: str | None = None
    """Unit of the event times: ns, us, ms or s."""
    size: tuple[int, int] | None = None
    """Resolution of the event sensor in pixels, width and height."""
    topic: str | None = None
    """Which of several cameras, streams or topics to take the events from."""
    image_topic: str | None = None
    """Which of several topics or cameras to take the images from; an empty text for none."""
    columns: str | None = None
    """Order of the columns in a table of events: xytp or txyp."""
    event_encoding: str | None = None
    """Encoding of a Prophesee RAW file: evt2, evt2.1, evt2.1-legacy or evt3."""
    frame_unit: str | None = None
    """Unit of the image times: ns, us, ms or s."""
    fps: float | None = None
    """Frames recorded per second, where no file gives their times, or a video is slow motion."""
    times: Path | None = None
    """The file with the image times, where there are several candidates."""

    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        return {
            name: value
            for name in ReaderOptions.__dataclass_fields__
            if (value := getattr(self, name)) is not None
        }

    def only(self, names: Collection[str]) -> "ReaderOptions":
        """These options without all others."""
        return ReaderOptions(**{k: v for k, v in self.given().items() if k in names})


NO_OPTIONS = ReaderOptions()


@dataclass(frozen=True)
class Format:
    """A kind of file that cameras and programs write."""

    name: str
    open: Callable[[Path, ReaderOptions], Recording]
    """Opens a file or folder of this format."""
    holds: str
    """Which data it holds, in words."""
    marks: str
    """How it is recognised, in words."""
    recognise: Callable[[Path, bytes], bool] = lambda path, head: False
    """Whether a path is of this format; takes the first bytes of the file, b"" for a folder."""
    suffixes: tuple[str, ...] = ()
    """File name suffixes that decide where no content does, in small letters."""
    options: tuple[str, ...] = ("size",)
    """Fields of `ReaderOptions` that `open` uses."""


def begins_with(*signatures: bytes) -> Callable[[Path, bytes], bool]:
    """Recognises files by their first bytes."""
    return lambda path, head: head.startswith(signatures)
