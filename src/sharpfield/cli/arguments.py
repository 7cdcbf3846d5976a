"""Arguments that several commands take, and the terminal they print to."""

from typing import Annotated, Literal

import tyro
from rich.console import Console

from sharpfield.core.errors import OptionError

Device = Literal["auto", "cpu", "cuda"]
Size = Annotated[str, tyro.conf.arg(metavar="WxH")]
Start = Annotated[float | None, tyro.conf.arg(name="from", metavar="MS")]
End = Annotated[float | None, tyro.conf.arg(name="to", metavar="MS")]


def parse_size(text: str) -> tuple[int, int]:
    """Width and height from `WxH`.

    Raises:
        OptionError: It is not of that form.
    """
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 7 and int(height) > 7):
        raise OptionError("cannot read the size", got=text, do="give it like 240x160, at least 8x8")
    return int(width), int(height)


def screen() -> Console:
    """The terminal; numbers in a text are not coloured."""
    return Console(highlight=False)
