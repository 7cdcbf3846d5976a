"""What a layout is: how a folder of this layout is recognised, how it is read, and its options.

Each module in `captures/layouts/` defines one `LAYOUT`; `captures.read.LAYOUTS` lists them. Another
package adds one by an entry point in its `pyproject.toml`:

    [project.entry-points."sharpfield.layouts"]
    my-dataset = "my_package.my_dataset:LAYOUT"
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # options are read without importing torch
    from sharpfield.core.capture import Capture

Missing = Literal["error", "skip"]
"""What to do about images that are listed but do not exist."""


@dataclass(frozen=True)
class ReadOptions:
    """How to read a capture, where its layout is wrong or silent; None leaves it to the layout.

    A new option is a field here, and its name in the `Layout.options` of the readers that use it.
    """

    layout: str | None = None
    """Name of the layout; by default it is recognised."""
    event_unit: str | None = None
    """Unit of event times: ns, us, ms or s."""
    missing: Missing | None = None
    """What to do about images that are listed but do not exist."""
    encoding: str | None = None
    """How stored values relate to light: linear, gamma2.2 or srgb."""
    hold_out: str | None = None
    """Frames to hold out for testing: every:8, train:5, last:5 or none."""
    threshold: float | None = None
    """Contrast threshold of the events for both signs, natural log."""
    factor: int | None = None
    """Read the images in `images_<factor>`; by default the smallest images there are."""
    bounds: tuple[float, float] | None = None
    """Nearest and farthest depth of the scene, in world units."""
    trust_pickle: bool = False
    """Open pickled files, which may name programs to run; only arrays of numbers are built from
    them, and anything else is refused."""

    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        return {name: value for name, value in vars(self).items() if value not in (None, False)}


NO_OPTIONS = ReadOptions()

FOR_ALL = ("layout", "encoding", "hold_out", "threshold", "bounds")
"""Options that `read_capture` applies to captures of every layout."""


@dataclass(frozen=True)
class Layout:
    """A way to lay out a capture on disk."""

    name: str
    recognise: Callable[[Path], bool]
    """Whether a folder has this layout, judged by its files without loading them."""
    read: Callable[[Path, ReadOptions], "Capture"]
    """Reads a folder of this layout."""
    marks: str
    """The files by which it is recognised, in words."""
    options: tuple[str, ...] = ()
    """Options that `read` takes besides those for every layout."""


LayoutName = Literal["native", "ev-deblur-nerf", "evdnerf", "scannet"]
