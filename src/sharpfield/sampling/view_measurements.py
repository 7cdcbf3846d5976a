"""What was measured of whole views: frames, latent frames, event windows and depth, as tensors.

Leading axes: m cameras, then k instants (or k - 1 windows); then the rows and columns of the crop.
Depth maps are resampled to the pixels of the frames.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.frames import LEAST_DEPTH, DepthMaps
from sharpfield.core.measurements import Depths, EventPairs, Instants, Pixels
from sharpfield.events.latent_frames import LatentFrames, SensorEstimate
from sharpfield.sampling.event_windows import CameraEvents, Times, counts_in_windows


class MeasuredDepth:
    """Depth for the pixels of frames.

    Args:
        maps: Of the depth camera.
        camera: Of the frames.
    """

    def __init__(self, maps: DepthMaps, camera: Camera) -> None:
        self.maps = maps
        ray = camera.direction(camera.grid().double())
        xy = maps.camera.project(ray / ray[..., 2:]).numpy()
        x, y = np.floor(xy[..., 0]).astype(np.int64), np.floor(xy[..., 1]).astype(np.int64)
        self.inside: Bool[np.ndarray, "h w"] = (
            (x >= 0) & (x < maps.camera.width) & (y >= 0) & (y < maps.camera.height)
        )
        self.column: Int64[np.ndarray, "h w"] = np.where(self.inside, x, 0)
        self.row: Int64[np.ndarray, "h w"] = np.where(self.inside, y, 0)

    def at(self, frame: int) -> Float32[np.ndarray, "h w"]:
        """Depth along the axis at every pixel of a frame; 0 where unknown."""
        seen = self.maps.at(frame)[self.row, self.column]
        return np.where(self.inside & (seen > LEAST_DEPTH), seen, 0).astype(np.float32)


Tracks = Int64[np.ndarray, "m"]
FrameRows = Int64[np.ndarray, "m"]


@dataclass(frozen=True)
class Crop:
    """A rectangle of the image, in pixels."""

    left: int
    top: int
    width: int
    height: int

    def of(self, image: Tensor, *, row_axis: int = 0) -> Tensor:
        """The rectangle of an image whose rows and columns are two axes that follow each other."""
        rows = image.narrow(row_axis, self.top, self.height)
        return rows.narrow(row_axis + 1, self.left, self.width)


class ViewMeasurements:
    """Looks up what was measured of views.

    Args:
        capture: In the model's space.
        cameras: The events of its cameras, by track.
    """

    def __init__(self, capture: Capture, cameras: dict[int, CameraEvents]) -> None:
        self.capture, self.cameras = capture, cameras
        depth = capture.depth
        self.measured_depth = None if depth is None else MeasuredDepth(depth, capture.camera)

    def instants(
        self, times: Times, weight: Float64[np.ndarray, "k"], tracks: Tracks, crop: Crop
    ) -> Instants:
        """The views `[m, k]` of some cameras at some times.

        Args:
            times: k of them.
            weight: Of each in the mean over the exposure.
            tracks: Of m cameras.
            crop: Of each image.
        """
        shape = len(tracks), len(times)
        return Instants(
            time=self._unit(times).expand(shape),
            track=torch.from_numpy(tracks)[:, None].expand(shape),
            weight=torch.from_numpy(weight).float().expand(shape),
            corner=torch.tensor([crop.left, crop.top]).expand(*shape, 2),
            size=(crop.width, crop.height),
        )

    def frames(self, frames: FrameRows, crop: Crop) -> Pixels:
        """The blurred frames `[m, h, w]`."""
        held = self.capture.needed_frames
        stored = torch.stack([torch.from_numpy(np.array(held.images[i])) for i in frames])
        value = crop.of(stored, row_axis=1).to(torch.float32) / held.white
        opens, closes = self.capture.frame_time[torch.from_numpy(frames)].T  # [m] each
        return self._pixels(value, frames, held.track[frames], (opens, closes), crop)

    def latent_frames(
        self,
        times: Times,
        tracks: Tracks,
        crop: Crop,
        sensor: SensorEstimate,
        frames: FrameRows | None = None,
    ) -> Pixels:
        """Latent frames `[m, h, w, k]` at some instants.

        Args:
            times: By the clock of the frames.
            tracks: Of m cameras.
            crop: Of each image.
            sensor: What is known of the event camera.
            frames: Whose exposure the views are of; by default the frame nearest to each camera's
                first instant.
        """
        sources = [self._latent_of(int(track)) for track in tracks]
        value = torch.stack(
            [torch.stack([crop.of(own.at(int(t), sensor)) for t in times], 2) for own in sources]
        )  # [m, h, w, k, c]
        if frames is None:
            middle = self.capture.needed_frames.exposure.middle_us
            nearest = [own.order[np.abs(middle[own.order] - times[0]).argmin()] for own in sources]
            frames = np.array(nearest)
        time = self._unit(times)
        return self._pixels(value, frames, tracks, (time, time), crop)

    def windows(self, times: Times, tracks: Tracks, crop: Crop) -> EventPairs:
        """Events at every pixel between instants, `[m, k - 1, h, w, c]`."""
        found = [counts_in_windows(self.cameras[int(track)], times) for track in tracks]
        negative, positive, slack = (
            crop.of(torch.stack(part), row_axis=2) for part in zip(*found, strict=True)
        )
        shape = negative.shape
        time = self._unit(times)[:, None, None, None]
        return EventPairs(
            xy=crop.of(self.capture.camera.grid())[:, :, None].expand(*shape, 2),
            track=torch.from_numpy(tracks).view(-1, 1, 1, 1, 1).expand(shape),
            start=time[:-1].expand(shape),
            end=time[1:].expand(shape),
            negative=negative,
            positive=positive,
            channel=torch.arange(3).expand(shape) if shape[-1] == 3 else None,
            slack=slack,
        )

    def depth(self, frames: FrameRows, instant: int, crop: Crop) -> Depths:
        """Measured depth `[m, h, w]` of some frames, and at which of the instants."""
        assert (measured := self.measured_depth) is not None
        maps = torch.stack([crop.of(torch.from_numpy(measured.at(int(i)))) for i in frames])
        return Depths(maps, torch.full((), instant).expand(maps.shape))

    def _latent_of(self, track: int) -> LatentFrames:
        assert (found := self.cameras[track].latent) is not None
        return found

    def _pixels(
        self,
        value: Tensor,
        frames: FrameRows,
        tracks: Tracks,
        window: tuple[Tensor, Tensor],
        crop: Crop,
    ) -> Pixels:
        """Pixels `[m, h, w]` or `[m, h, w, k]`; times are of each frame, or of each instant."""
        shape = value.shape[:-1]
        each = (-1, *[1] * (len(shape) - 1))  # one number for each camera
        xy = crop.of(self.capture.camera.grid())
        if of_instants := len(shape) == 4:
            xy = xy[:, :, None]
        opens, closes = (t if of_instants else t.view(each) for t in window)
        return Pixels(
            xy=xy.expand(*shape, 2),
            frame=torch.from_numpy(frames).view(each).expand(shape),
            track=torch.from_numpy(tracks).view(each).expand(shape),
            open=opens.expand(shape),
            close=closes.expand(shape),
            value=value,
        )

    def _unit(self, times_us: Times) -> Tensor:
        """Times as views carry them, 0...1 of the capture."""
        return torch.from_numpy(self.capture.clock.unit(times_us)).float()
