"""Options of the commands that prepare captures, in a module that imports nothing heavy."""

from dataclasses import dataclass
from typing import Literal

from sharpfield.core.errors import OptionError

Method = Literal["exact", "joint", "published"]
ImageSource = Literal["auto", "edi", "frames", "sharpest"]
Intrinsics = Literal["given", "refine", "find"]
Lens = Literal["pinhole", "radial", "brown", "fisheye"]


@dataclass(frozen=True)
class DeblurOptions:
    """How frames are deblurred."""

    threshold: float | Literal["known", "find"] = "known"
    """Contrast threshold of both polarities. `known` takes those that the capture states, and
    searches for them where it states none; `find` always searches."""
    method: Method = "exact"
    """`exact`: in linear light, integrated from event to event. `joint`: the same, then all frames
    are made consistent with the events between them. `published`: as in the released Ev-DeblurNeRF,
    on stored values with eight slices."""
    instants: int = 1
    """Images per exposure, at the middles of as many equal parts of it. Only for `exact`."""

    def __post_init__(self) -> None:
        if self.instants < 1 or (self.instants > 1 and self.method != "exact"):
            raise OptionError(
                "only the exact method gives several images per exposure",
                got=f"{self.instants} with method {self.method}",
                do="use method `exact`, or 1 instant",
            )


@dataclass(frozen=True)
class QualityOptions:
    """How the sharpness of frames is measured."""

    source: Literal["auto", "images", "events"] = "auto"
    """Measure by images or by events; auto uses events where the capture has them."""
    overlap: Literal["auto", "depth", "flow"] = "auto"
    """Overlap of two images: by depth (auto, where there is some) or by optical flow."""
    way: Literal["reconciled", "published"] = "reconciled"
    """Compare each frame with several neighbours; or as published, with the next only."""
    every_frame: bool = False
    """Include held-out frames."""


@dataclass(frozen=True)
class PoseOptions:
    """How poses are found by structure from motion."""

    images: ImageSource = "auto"
    """`edi`: frames deblurred with their events. `frames`: as recorded. `sharpest`: only the
    sharpest of each three neighbours. `auto`: `edi` where there are events and exposures."""
    instants: int | None = None
    """Images of each exposure, with `edi`; more give a finer trajectory and take longer. By default
    three, or fewer where that would be more than 120 images."""
    intrinsics: Intrinsics | None = None
    """`given` keeps the camera, `refine` starts from its focal length, `find` estimates all; by
    default `given`, or `find` where the focal length of the capture is unknown."""
    lens: Lens = "pinhole"
    """Lens model to estimate with `find`."""
    seed: int = 0
    """Random seed of RANSAC."""


@dataclass(frozen=True)
class CalibrateOptions:
    """How thresholds are measured."""

    pairs: int = 12
    """Number of exposure pairs, spread over the capture."""
    seed: int = 0
    """Random seed of the bootstrap."""
