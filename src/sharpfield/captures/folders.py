"""Writing a capture must never destroy something that is not one."""

from collections.abc import Callable
from pathlib import Path

from sharpfield.core.errors import CaptureError


def expect_replaceable(folder: Path, recognise: Callable[[Path], bool]) -> None:
    """Make sure that a folder may be written: it is new, empty, or holds an earlier capture.

    Args:
        folder: What is about to be replaced.
        recognise: Whether a folder holds a capture of the layout to be written.

    Raises:
        CaptureError: It holds something else.
    """
    if not folder.exists() or (
        folder.is_dir() and (recognise(folder) or not any(folder.iterdir()))
    ):
        return
    raise CaptureError(
        "will not replace what is not a capture",
        where=folder,
        do="choose another place, or empty it",
    )
