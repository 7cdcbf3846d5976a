"""Captures written to disk in the layouts that other programs read."""

from pathlib import Path
from typing import Literal

from sharpfield.captures.native import layout as native
from sharpfield.captures.writers import evdnerf, llff_events, scannet
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError

LayoutName = Literal["native", "ev-deblur-nerf", "evdnerf", "scannet"]

WRITERS = {
    "native": native.write,
    "ev-deblur-nerf": llff_events.write,
    "evdnerf": evdnerf.write,
    "scannet": scannet.write,
}


def write(capture: Capture, folder: Path | str, layout: str = "native") -> None:
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
    if layout not in WRITERS:
        raise OptionError(
            "unknown layout to write",
            got=layout,
            do=f"use one of {', '.join(WRITERS)}",
        )
    WRITERS[layout](capture, Path(folder))
