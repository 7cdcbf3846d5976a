"""Images on the capture's clock."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped, UInt8, UInt16

from sharpfield.core.errors import CaptureError
from sharpfield.core.exposure import Exposure

ENCODINGS = ("linear", "gamma2.2", "srgb")
"""How stored values relate to light: not at all bent, by a power of 1/2.2, by the sRGB curve."""


@dataclass(frozen=True)
class Frames:
    """Images, when each was exposed, and on which track.

    `images` hold what was stored, display-referred unless `encoding` is "linear"; 8 or 16 bit, with
    1 or 3 channels (RGB). `truth`, where known, is the sharp image at the middle of each
    exposure, in the same encoding; `truth_known` says for which frames, all if it is None. `depth`
    and `flow`, where known, say what the scene was like at that instant.
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
        if self.encoding not in ENCODINGS:
            raise CaptureError(
                "unknown image encoding", got=self.encoding, do=f"use one of {', '.join(ENCODINGS)}"
            )
        for track in np.unique(self.track):
            self._no_overlap(int(track))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.images)

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
