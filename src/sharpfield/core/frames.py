"""Frames on the capture's clock, their exposures, and the depth maps measured with them.

Depth is along the camera's axis, at pixel centres. The depth camera may have fewer pixels than the
frames and a lens of its own, but the same pose as the frame camera (data sets call that
*registered*). Maps stay as sensors store them, 16 bit, so that they can be mapped from disk.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8, UInt16

from sharpfield.core.camera import Camera
from sharpfield.core.errors import CaptureError, expect_arrays


@dataclass(frozen=True)
class Exposure:
    """Opening and closing time of the shutter for each frame, in us on the capture's clock.

    A frame with `open_us == close_us` is an instant: an image without motion blur.
    """

    open_us: Int64[np.ndarray, "n"]
    close_us: Int64[np.ndarray, "n"]
    row_delay_us: float = 0.0
    """Each row opens and closes this much later than the one above: a rolling shutter. Times are
    those of the first row."""

    def __post_init__(self) -> None:
        expect_arrays(self)
        wrong = np.flatnonzero(self.close_us < self.open_us)
        if len(wrong):
            i = wrong[0]
            raise CaptureError(
                "an exposure ends before it begins",
                where=f"frame {i}",
                got=f"opens at {self.open_us[i]} us, closes at {self.close_us[i]} us",
                do="check the order of the two columns of exposure times",
            )
        if self.row_delay_us < 0:
            raise CaptureError(
                "rows of a rolling shutter must follow each other downwards",
                got=f"a row delay of {self.row_delay_us:g} us",
                do="turn frames and events upside down",
            )

    def __repr__(self) -> str:
        if not len(self):
            return "Exposure(0 frames)"
        short, long = self.duration_us.min(), self.duration_us.max()
        length = f"{short}" if short == long else f"{short} to {long}"
        rolling = f", row delay {self.row_delay_us:g} us" if self.row_delay_us else ""
        span = f"{self.open_us.min()} to {self.close_us.max()}"
        return f"Exposure({len(self)} frames, {span} us, each {length} us{rolling})"

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.open_us)

    @property
    def middle_us(self) -> Int64[np.ndarray, "n"]:
        """Middle of each exposure."""
        return self.open_us + (self.close_us - self.open_us) // 2

    @property
    def duration_us(self) -> Int64[np.ndarray, "n"]:
        """How long each shutter was open."""
        return self.close_us - self.open_us

    @property
    def instant(self) -> Bool[np.ndarray, "n"]:
        """Whether a frame was taken at one instant, free of motion blur by construction."""
        return self.open_us == self.close_us

    def readout_us(self, height: int) -> float:
        """How much later the last of so many rows is exposed than the first."""
        return self.row_delay_us * (height - 1)

    def window(self, frame: int) -> tuple[int, int]:
        """Opening and closing time of one frame, in us."""
        return int(self.open_us[frame]), int(self.close_us[frame])


ENCODINGS = ("linear", "gamma2.2", "srgb")
"""Tone curves of stored values: linear, a power of 1/2.2, the sRGB curve."""


@dataclass(frozen=True)
class Frames:
    """Images, when each was exposed, and on which track.

    `images` hold what was stored, display-referred unless `encoding` is "linear"; 8 or 16 bit, with
    1 or 3 channels (RGB). `truth`, where known, is the sharp image at the middle of each
    exposure, in the same encoding; `truth_known` says for which frames, all if it is None. `depth`
    and `flow`, where known, are those of the scene at that instant.
    """

    images: UInt8[np.ndarray, "n h w c"] | UInt16[np.ndarray, "n h w c"]
    exposure: Exposure
    track: Int64[np.ndarray, "n"]
    names: tuple[str, ...]
    encoding: str = "gamma2.2"
    truth: Shaped[np.ndarray, "n h w c"] | None = None
    truth_known: Shaped[np.ndarray, "n"] | None = None
    depth: Float32[np.ndarray, "n h w"] | None = None
    """Along the camera's axis, at pixel centres, in world units; infinite where nothing is."""
    flow: Float32[np.ndarray, "n h w 2"] | None = None
    """How fast the point seen at a pixel's centre moves over the image (x, y), in px per second."""
    blur_px: Float64[np.ndarray, "n"] | None = None
    """True length of the motion blur of each frame, where it is known."""

    def __post_init__(self) -> None:
        counts = {
            "images": len(self.images),
            "exposures": len(self.exposure),
            "tracks": len(self.track),
            "names": len(self.names),
        }
        if len(set(counts.values())) != 1:
            raise CaptureError(
                "there must be one exposure, track and name for each image",
                got=", ".join(f"{count} {name}" for name, count in counts.items()),
            )
        expect_arrays(self)
        if self.channels not in (1, 3):
            raise CaptureError("images are grey or RGB", got=f"{self.channels} channels")
        if self.encoding not in ENCODINGS:
            raise CaptureError(
                "unknown image encoding", got=self.encoding, do=f"use one of {', '.join(ENCODINGS)}"
            )
        for track in np.unique(self.track):
            self._no_overlap(int(track))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.images)

    def __repr__(self) -> str:
        known = int(self.with_truth.sum())
        truth = f", {known} with sharp truth" if known else ""
        kind = f"{self.images.dtype}, {self.channels} channels, {self.encoding}"
        return f"Frames({len(self)} of {self.width}x{self.height}, {kind}{truth})"

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return self.images.shape[2]

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (RGB)."""
        return self.images.shape[3]

    @property
    def with_truth(self) -> Bool[np.ndarray, "n"]:
        """Which frames have a sharp truth."""
        if self.truth is None or self.truth_known is None:
            return np.full(len(self), self.truth is not None)
        return np.asarray(self.truth_known, bool)

    @property
    def white(self) -> int:
        """The stored value that means 1."""
        return int(np.iinfo(self.images.dtype).max)

    def _no_overlap(self, track: int) -> None:
        member = np.flatnonzero(self.track == track)
        order = member[np.argsort(self.exposure.open_us[member], kind="stable")]
        opens, closes = self.exposure.open_us[order], self.exposure.close_us[order]
        wrong = np.flatnonzero(opens[1:] < closes[:-1])
        if len(wrong):
            i = wrong[0]
            raise CaptureError(
                f"frames {order[i]} and {order[i + 1]} overlap in time",
                where=f"exposures of {self.names[order[i]]} and {self.names[order[i + 1]]}"
                f" (track {track})",
                got=f"one closes at {closes[i]} us, the next opens at {opens[i + 1]} us",
                do="check the exposure times; a second camera is a second track",
            )


MILLIMETRE = 0.001
"""One step of stored depth of most sensors, in metres."""


@dataclass(frozen=True)
class DepthMaps:
    """A measured depth map for each frame; unlike `Frames.depth`, which is the truth."""

    stored: UInt16[np.ndarray, "n h w"]
    """In steps of `unit`; 0 where nothing was measured."""
    camera: Camera
    """Lens and sensor of the depth camera."""
    unit: float = MILLIMETRE
    """World units in one step."""

    def __post_init__(self) -> None:
        if self.stored.shape[1:] != self.camera.size[::-1]:
            raise CaptureError(
                "depth maps and their camera have different sizes",
                got=f"maps {self.stored.shape[2]}x{self.stored.shape[1]},"
                f" camera {self.camera.width}x{self.camera.height}",
                do="give the intrinsics of the depth camera",
            )
        if not self.unit > 0:
            raise CaptureError("a step of depth must be positive", got=self.unit)

    def __repr__(self) -> str:
        return f"DepthMaps({len(self)} of {self.camera.width}x{self.camera.height})"

    def __len__(self) -> int:
        """Number of maps."""
        return len(self.stored)

    def at(self, frame: int) -> Float32[np.ndarray, "h w"]:
        """Depth of one frame in world units; 0 where unknown."""
        return np.asarray(self.stored[frame]).astype(np.float32) * np.float32(self.unit)

    def rays(self) -> Float32[np.ndarray, "h w 3"]:
        """Directions of all pixels in camera axes, with a z of 1: times depth, they are points."""
        unit = self.camera.direction(self.camera.grid().double())
        return (unit / unit[..., 2:]).to(torch.float32).numpy()


LEAST_DEPTH = 1e-6
"""Below this a stored depth means that nothing was measured."""
