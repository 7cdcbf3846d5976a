"""Captures written to disk in the layouts that other programs read."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sharpfield.core.errors import OptionError, did_you_mean

if TYPE_CHECKING:  # names of layouts are read without importing torch
    from sharpfield.core.capture import Capture

LayoutName = Literal["native", "ev-deblur-nerf", "evdnerf", "scannet"]
WRITERS: dict[str, str] = {
    "native": "native.layout",
    "ev-deblur-nerf": "writers.llff_events",
    "evdnerf": "writers.evdnerf",
    "scannet": "writers.scannet",
}
"""Modules in `sharpfield.captures`, each with a function `write`."""


def write(capture: "Capture", folder: Path | str, layout: str = "native") -> None:
    """Write a capture; the folder appears whole or not at all. An earlier capture is replaced.

    Args:
        capture: To be written.
        folder: Where.
        layout: native, which keeps everything; ev-deblur-nerf, evdnerf, scannet.

    Raises:
        OptionError: There is no such layout.
        CaptureError: The folder holds something else, or the capture holds something the layout
            has no place for.
    """
    expect_capture(capture)
    if layout not in WRITERS:
        raise OptionError(
            "unknown layout to write",
            got=layout,
            do=did_you_mean(layout, WRITERS),
        )
    import_module(f"sharpfield.captures.{WRITERS[layout]}").write(capture, Path(folder))


def expect_capture(capture: object) -> None:
    """Make sure that this is a capture, and that its events are valid; it may be made by hand.

    Raises:
        OptionError: It is something else.
        ShapeError: A column of its events has another type.
        CaptureError: Its events are not valid.
    """
    from sharpfield.core.capture import Capture
    from sharpfield.core.events import checked

    if not isinstance(capture, Capture):
        raise OptionError(
            "this is not a capture",
            got=type(capture).__name__,
            do="give what sf.read or sf.simulate return; sf.train also takes a folder",
        )
    if capture.events is not None:
        checked(capture.events, capture.name)
