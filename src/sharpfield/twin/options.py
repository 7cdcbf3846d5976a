"""Options of the event twin: its camera, its pixels, and what is written of its events."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sharpfield.core.errors import OptionError

if TYPE_CHECKING:  # options are read without importing torch
    from sharpfield.twin.event_twin import TimeSteps

RECORDED = "recorded"
"""Name of a sensor with ideal pixels and the thresholds that the capture states."""


def microseconds(ms: float) -> int:
    """Milliseconds in whole microseconds."""
    return round(1000 * ms)


@dataclass(frozen=True)
class ViewpointOptions:
    """Position and resolution of the event camera, and the time it records."""

    view: int | None = None
    """Number of a camera (track) of the capture; 0 by default."""
    trajectory: Path | None = None
    """Path of another camera: a text file in TUM's format, or the trajectory.npz of a capture."""
    start_ms: Annotated[float | None, tyro.conf.arg(name="from", metavar="MS")] = None
    """Start of the recording, in ms after the start of the camera's path."""
    end_ms: Annotated[float | None, tyro.conf.arg(name="to", metavar="MS")] = None
    """End of the recording, in ms after the start of the camera's path."""
    on_ms: Annotated[float | None, tyro.conf.arg(name="on", metavar="MS")] = None
    """Time at which the camera is switched on, before the recording starts, so that every pixel has
    a reference level of its own; by default the start of the recording, or with a comparison the
    start of the path."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Sensor resolution, WIDTHxHEIGHT, or `sensor` for that of the named sensor; by default the
    resolution of the capture."""

    def __post_init__(self) -> None:
        if self.trajectory is not None and self.view is not None:
            raise OptionError(
                "a camera follows a view of the capture or a path of its own, not both",
                got=f"--view {self.view} and --trajectory {self.trajectory}",
                do="leave one of them out",
            )


@dataclass(frozen=True)
class PixelOptions:
    """Pixels of the event camera, and the time steps of rendering."""

    sensor: str = RECORDED
    """Name of the sensor: ideal, dvs346, gen3-vga, gen4-hd; or recorded, ideal pixels with the
    thresholds, dead time and colour filter that the capture states."""
    threshold: float | None = None
    """Contrast threshold of both signs, instead of the sensor's own."""
    match: bool = False
    """Scale the thresholds so that the scene makes as many events as were recorded, outside the
    time that is rendered."""
    seed: int = 0
    """Random seed of the differences between pixels, and of the noise."""
    subpixels: int = 1
    """Rays per pixel along each side, whose mean is the light of the pixel."""
    step_ms: float = 4.0
    """Time between two rendered images where nothing changes."""
    shortest_ms: float = 1.0
    """Time between two rendered images where light changes fastest."""
    most_change: float = 2.0
    """Largest change of any pixel between two images, in thresholds."""

    def time_steps(self) -> "TimeSteps":
        """Steps of time."""
        from sharpfield.twin.event_twin import TimeSteps

        return TimeSteps(
            microseconds(self.step_ms), self.most_change, microseconds(self.shortest_ms)
        )


@dataclass(frozen=True)
class ExtraOptions:
    """Event frames and comparisons, beside the file of events."""

    frames: Annotated[float | None, tyro.conf.arg(metavar="MS")] = None
    """Write event frames of windows of this length, as arrays and images."""
    least_share: float = 0.0
    """Leave out of frames and images what is less than this share of a frame's largest count;
    0.3 as in the published figures."""
    compare: bool = False
    """Compare the events with those that the capture's own camera recorded."""
    against: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Compare the events with those of a file, on the clock of the capture."""

    def __post_init__(self) -> None:
        if self.compare and self.against is not None:
            raise OptionError(
                "events are compared with the capture's or with those of a file, not with both",
                do="leave out --compare or --against",
            )
        if not 0 <= self.least_share <= 1:
            raise OptionError("a share lies between 0 and 1", got=self.least_share)

    @property
    def compares(self) -> bool:
        """Whether anything is compared."""
        return self.compare or self.against is not None

    def expect_comparable(self, camera: ViewpointOptions) -> None:
        """Refuse to compare the capture's events with those of another camera.

        Raises:
            OptionError: The camera is not one of the capture's.
        """
        if self.compare and (camera.trajectory is not None or camera.size is not None):
            raise OptionError(
                "only a camera of the capture, at its own size, has recorded events to compare"
                " with",
                do="leave out --trajectory and --size, or name a recording with --against",
            )
