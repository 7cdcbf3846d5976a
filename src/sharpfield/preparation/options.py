"""Options of the preparing commands, apart from what they do, so that reading them is quick."""

from dataclasses import dataclass
from typing import Literal

from sharpfield.core.errors import OptionError

Method = Literal["exact", "joint", "published"]
Source = Literal["auto", "edi", "frames", "sharpest"]
Intrinsics = Literal["given", "refine", "find"]
Lens = Literal["pinhole", "radial", "brown", "fisheye"]


@dataclass(frozen=True)
class DeblurOptions:
    """How frames are deblurred."""

    threshold: float | Literal["known", "find"] = "known"
    """Contrast threshold of both signs. `known` takes what the capture's source says and finds
    thresholds where it is silent; `find` finds them in any case."""
    method: Method = "exact"
    """`exact`: in linear light, integrated from event to event. `joint`: the same, then all frames
    made to agree with the events between them. `published`: as the released Ev-DeblurNeRF does it,
    on stored values with eight slices."""
    instants: int = 1
    """Images per exposure, in the middles of as many equal parts of it. Only for `exact`."""

    def __post_init__(self) -> None:
        if self.instants < 1 or (self.instants > 1 and self.method != "exact"):
            raise OptionError(
                "only the exact method gives several images per exposure",
                got=f"{self.instants} with method {self.method}",
                do="use method `exact`, or 1 instant",
            )


@dataclass(frozen=True)
class QualityOptions:
    """How frames are judged."""

    source: Literal["auto", "images", "events"] = "auto"
    """What tells: auto takes events where the capture has them."""
    overlap: Literal["auto", "depth", "flow"] = "auto"
    """What two images both show: by depth (auto, where there is some) or optical flow."""
    way: Literal["reconciled", "published"] = "reconciled"
    """Compare with several neighbours; or as published, with the next only."""
    every_frame: bool = False
    """Judge held-out frames, too."""


@dataclass(frozen=True)
class PoseOptions:
    """How poses are found."""

    images: Source = "auto"
    """`edi`: frames deblurred with their events. `frames`: as they are. `sharpest`: only the
    sharpest of each three neighbours. `auto`: `edi` where there are events and exposures."""
    instants: int | None = None
    """Images taken from each exposure, with `edi`; more make the path finer, and take longer.
    By default three, or fewer where that would be more than 120 images."""
    intrinsics: Intrinsics | None = None
    """`given` keeps the camera, `refine` starts from its focal length, `find` knows nothing; by
    default `given`, or `find` where the capture does not know its focal length."""
    lens: Lens = "pinhole"
    """What to look for, with `find`."""
    seed: int = 0
    """Of what is drawn by chance."""


@dataclass(frozen=True)
class CalibrateOptions:
    """How thresholds are measured."""

    pairs: int = 12
    """Pairs of exposures looked at, spread over the capture."""
    seed: int = 0
    """Of the bootstrap."""
