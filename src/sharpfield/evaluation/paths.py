"""Camera paths of rendered videos: poses and times in the world of a capture.

    spiral        around the average camera of a forward-facing capture, else around the scene
    train         along the trajectory of the recording, or from photo to photo
    exposure:N    through the exposure of frame N, from the opening to the closing of its shutter

Source of the spiral: Mildenhall et al., *Local Light Field Fusion* (SIGGRAPH 2019).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.struct import device_of
from sharpfield.geometry.normalise import focus
from sharpfield.geometry.space import average_pose, forward_facing
from sharpfield.geometry.trajectory import Stamped

TURNS = 2
"""Number of turns of the spiral."""

FORWARD_CYCLES = 0.5
"""Cycles along the viewing direction for each turn of the spiral."""

RADIUS_PERCENTILE = 90
"""Percentile of the distances from the average camera that is the radius of the spiral."""

PATHS = "spiral, train, or exposure:N with the number of a frame"


@dataclass(frozen=True)
class RenderPath:
    """Pose and time of each image of a video."""

    poses: Float32[np.ndarray, "n 3 4"]
    """World-from-camera."""
    time: Float32[np.ndarray, "n"]
    """0...1 of the capture."""

    def __len__(self) -> int:
        """Number of images."""
        return len(self.time)


def camera_path(capture: Capture, path: str, *, images: int = 60) -> RenderPath:
    """A path by name.

    Args:
        capture: In the world to render in: a model's own capture.
        path: `spiral`, `train` or `exposure:N`.
        images: Number of images.

    Raises:
        OptionError: There is no such path, or the capture does not have it.
    """
    if images < 1:
        raise OptionError("a path needs at least one image", got=images)
    kind, _, argument = path.partition(":")
    if kind == "exposure" and argument.isdecimal():
        return path_in_exposure(capture, int(argument), images)
    if path == "spiral":
        return spiral_path(capture, images)
    if path == "train":
        return recorded_path(capture, images)
    raise OptionError("unknown camera path", got=path, do=f"use {PATHS}")


def spiral_path(capture: Capture, images: int) -> RenderPath:
    """Around the scene, while time runs through the capture.

    For forward-facing cameras LLFF's spiral around the average camera, as wide as the cameras are
    apart; else a circle around the point that the cameras face.
    """
    poses = _reference_poses(capture)
    angle = np.linspace(0, 2 * math.pi * TURNS, images, endpoint=False)
    target = None if forward_facing(poses) else focus(poses)
    if target is None:
        made = _spiral(poses, angle, capture.near, capture.far)
    else:
        made = _circle(poses, target, angle / TURNS)
    time = np.linspace(0, 1, images) if images > 1 else np.full(1, 0.5)
    return RenderPath(made.astype(np.float32), time.astype(np.float32))


def recorded_path(capture: Capture, images: int) -> RenderPath:
    """Along the recording: evenly in time if the camera motion is known, else photo to photo."""
    known = capture.trajectory.known_us(0)
    if known is not None:
        return _on_track(capture, _between(capture, *known, images), 0)
    train, exposure = capture.split.train, capture.needed_frames.exposure
    stamps, poses = exposure.middle_us[train], _frame_poses(capture, train)
    # Unordered photos: a spline would overshoot, linear interpolation stays between them.
    through = Stamped(stamps, poses, capture.clock, translation="linear")
    time = _between(capture, int(stamps[0]), int(stamps[-1]), images).astype(np.float32)
    made = through.pose(torch.from_numpy(time), torch.zeros(images).long())
    return RenderPath(made.numpy(), time)


def path_in_exposure(capture: Capture, frame: int, images: int) -> RenderPath:
    """Through the exposure of one frame, both ends included.

    Raises:
        OptionError: There is no such frame, or it has no exposure time.
    """
    frames = capture.needed_frames
    if frame >= len(frames):
        raise OptionError(
            "no such frame", got=frame, do=f"use a number from 0 to {len(frames) - 1}"
        )
    if frames.exposure.instant[frame]:
        raise OptionError(
            "this frame was taken in one instant, so nothing moves in its exposure",
            where=f"frame {frames.names[frame]}",
            do="choose a frame with an exposure time, or another path",
        )
    opens, closes = frames.exposure.open_us[frame], frames.exposure.close_us[frame]
    time = _between(capture, int(opens), int(closes), images)
    return _on_track(capture, time, int(frames.track[frame]))


def _spiral(
    poses: Float[np.ndarray, "n 3 4"], angle: Float[np.ndarray, "m"], near: float, far: float
) -> Float[np.ndarray, "m 3 4"]:
    middle = average_pose(poses)
    offsets = (poses[:, :, 3] - middle[:, 3]) @ middle[:, :3]  # [n, 3], axes of the average camera
    radius = np.percentile(np.abs(offsets), RADIUS_PERCENTILE, axis=0)
    # LLFF focuses at a depth between 0.9 near and 5 far, three quarters of the way in disparity.
    depth = 1 / (0.25 / (0.9 * near) + 0.75 / (5 * far))
    offset = radius * np.stack([np.cos(angle), np.sin(angle), np.sin(FORWARD_CYCLES * angle)], -1)
    centre = middle[:, 3] + offset @ middle[:, :3].T
    target = middle[:, 3] + depth * middle[:, 2]
    return _facing(centre, target, middle[:, 1])


def _circle(
    poses: Float[np.ndarray, "n 3 4"], target: Float[np.ndarray, "3"], angle: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "m 3 4"]:
    """Around the vertical axis through the target, at the cameras' mean height and distance."""
    down = poses[:, :, 1].sum(0)
    down = down / np.linalg.norm(down)
    from_target = poses[:, :, 3] - target
    height = from_target @ down
    radius = np.linalg.norm(from_target - height[:, None] * down, axis=-1).mean()
    first = from_target[0] - height[0] * down
    first = first / np.linalg.norm(first)
    around = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(down, first)
    return _facing(target + height.mean() * down + radius * around, target, down)


def _facing(
    centre: Float[np.ndarray, "m 3"], target: Float[np.ndarray, "3"], down: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "m 3 4"]:
    """Poses at some positions that face a point, with a level horizon."""
    forward = target - centre
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(down, forward)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward, centre], -1)


def _reference_poses(capture: Capture) -> Float[np.ndarray, "n 3 4"]:
    """Poses of the training frames; without frames, poses along the trajectory."""
    if capture.frames is not None:
        chosen = capture.split.train if len(capture.split.train) else np.arange(len(capture.frames))
        return _frame_poses(capture, chosen)
    return recorded_path(capture, 100).poses.astype(np.float64)


def _frame_poses(capture: Capture, frames: Int64[np.ndarray, "m"]) -> Float[np.ndarray, "m 3 4"]:
    all_frames = capture.needed_frames
    time = capture.clock.unit(all_frames.exposure.middle_us[frames])
    return _poses(capture, time, all_frames.track[frames]).astype(np.float64)


def _between(capture: Capture, first_us: int, last_us: int, images: int) -> Float[np.ndarray, "n"]:
    first, last = capture.clock.unit(np.array([first_us, last_us]))
    return np.linspace(first, last, images)


def _on_track(capture: Capture, time: Float[np.ndarray, "n"], track: int) -> RenderPath:
    tracks = np.full(len(time), track)
    return RenderPath(_poses(capture, time, tracks), time.astype(np.float32))


@torch.no_grad()
def _poses(
    capture: Capture, time: Float[np.ndarray, "n"], track: Int64[np.ndarray, "n"]
) -> Float32[np.ndarray, "n 3 4"]:
    device = device_of(capture.trajectory)
    at = torch.from_numpy(time).float().to(device), torch.from_numpy(track).to(device)
    return capture.trajectory.pose(*at).float().cpu().numpy()
