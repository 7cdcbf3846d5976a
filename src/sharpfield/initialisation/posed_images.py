"""Sharp images with known poses: what a sparse point cloud is triangulated from."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture
from sharpfield.core.seed import evenly_spread
from sharpfield.core.tone import tone_of
from sharpfield.events.counts import EventMotion
from sharpfield.events.double_integral import latent
from sharpfield.events.threshold import FixedThresholds
from sharpfield.sampling.event_windows import with_events_of

MAX_IMAGES = 200
"""In float32 these are 0.7 GB at 640x480."""


@dataclass(frozen=True)
class Images:
    """Images of one camera and their poses."""

    camera: Camera
    light: Float[np.ndarray, "n h w c"]
    """Linear, 0...1."""
    poses: Float[np.ndarray, "n 3 4"]
    """World-from-camera."""
    near: float
    far: float

    def __len__(self) -> int:
        """How many there are."""
        return len(self.light)

    def directions(self, xy: Float[np.ndarray, "m 2"], view: int) -> Float[np.ndarray, "m 3"]:
        """Unit directions, in the world, seen by pixels of an image."""
        ray = self.camera.direction(torch.from_numpy(xy.astype(np.float64))).numpy()
        return ray @ self.poses[view, :, :3].T

    def project(
        self, points: Float[np.ndarray, "m 3"], view: int
    ) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m"]]:
        """Pixels of points in an image, and their depth along its axis.

        Points nearer than half the nearest depth get the depth -1 and no pixel.
        """
        pose = self.poses[view]
        seen = (points.astype(np.float64) - pose[:, 3]) @ pose[:, :3]
        depth = seen[:, 2]
        ahead = depth > 0.5 * self.near
        xy = np.full((len(points), 2), -1.0)
        xy[ahead] = self.camera.project(torch.from_numpy(seen[ahead])).numpy()
        return xy, np.where(ahead, depth, -1.0)

    def inside(self, xy: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, "m"]:
        """Which positions are on the image."""
        x, y = xy.T
        return (x >= 0) & (x < self.camera.width) & (y >= 0) & (y < self.camera.height)

    def light_at(self, xy: Float[np.ndarray, "m 2"], view: int) -> Float[np.ndarray, "m c"]:
        """Linear light of the pixels of an image at some positions."""
        x, y = np.minimum(xy.astype(np.int64), np.array(self.camera.size) - 1).T
        return self.light[view, y, x]


def sharp_images(
    capture: Capture, thresholds: FixedThresholds, *, most: int = MAX_IMAGES
) -> Images:
    """The training frames, deblurred to the middle of their exposure where there are events.

    Args:
        capture: With frames, in the space that the images are to have.
        thresholds: Of the events, if there are any.
        most: Of a long capture, so many frames spread over it.

    Raises:
        CaptureError: There are no frames, or events and frames differ in size.
    """
    frames, chosen = capture.needed_frames, evenly_spread(capture.split.train, most)
    light = np.empty((len(chosen), *frames.images.shape[1:]), np.float32)
    for view, image in enumerate(sharp_light_images(capture, thresholds, chosen)):
        light[view] = image.numpy()
    poses = capture.frame_pose(chosen).detach().double().numpy()
    return Images(capture.camera, light, poses, capture.near, capture.far)


def sharp_light_images(
    capture: Capture, thresholds: FixedThresholds, chosen: Int64[np.ndarray, "m"]
) -> Iterator[Float[Tensor, "h w c"]]:
    """The linear light of some frames, one after the other, see `sharp_images`."""
    frames = capture.needed_frames
    tone = tone_of(frames.encoding)
    motions: dict[int, EventMotion] = {}  # of the cameras with events, by track
    if capture.events is not None and not frames.exposure.instant[chosen].all():
        for track in np.unique(frames.track[chosen]).tolist():
            if track < capture.events.tracks:
                motions[track] = EventMotion.of(with_events_of(capture, track))
    for i in chosen:
        motion = motions.get(int(frames.track[i]))
        stored = torch.from_numpy(frames.images[i].astype(np.float32)) / frames.white
        image = tone.decode(stored)
        if motion is not None and not frames.exposure.instant[i]:
            middle = frames.exposure.middle_us[i : i + 1]
            path = motion.path(frames.exposure.window(int(i)), middle, thresholds)
            image = latent(image, path, 0)
        yield image.clamp(0, 1)
