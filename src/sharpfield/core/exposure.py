"""When the shutter was open."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64

from sharpfield.core.errors import CaptureError


@dataclass(frozen=True)
class Exposure:
    """Opening and closing time of the shutter for each frame, in us on the capture's clock.

    A frame with `open_us == close_us` is an instant: a sharp picture, as far as motion goes.
    """

    open_us: Int64[np.ndarray, "n"]
    close_us: Int64[np.ndarray, "n"]
    row_delay_us: float = 0.0
    """Each row opens and closes this much later than the one above: a rolling shutter. Times are
    those of the first row."""

    def __post_init__(self) -> None:
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
