"""`sharpfield deblur`: sharpen frames with their events, without training."""

from pathlib import Path

from tyro.conf import Positional

from sharpfield.captures.layout import ReadOptions
from sharpfield.cli.arguments import screen
from sharpfield.preparation.options import DeblurOptions

DEBLURRING = DeblurOptions()


def deblur_command(
    capture: Positional[Path],
    out: Path,
    layout: str | None = None,
    options: DeblurOptions = DEBLURRING,
) -> None:
    """Sharpen blurry frames with the event double integral; nothing is trained.

    Args:
        capture: Folder of the capture.
        out: Folder for the images, a contact sheet and `deblur.json`.
        layout: Layout of the capture, if it is not recognised.
        options: Thresholds, method, number of images.
    """
    from sharpfield.captures.read import read_capture
    from sharpfield.preparation.deblurring import deblur_to

    deblur_to(read_capture(capture, ReadOptions(layout=layout), poses=False), out, options)
    screen().print(f"Sharp frames are in {out}")
