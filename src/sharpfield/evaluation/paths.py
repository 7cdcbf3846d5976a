"""Camera paths to render videos along: poses and times, in the space of the capture they are for.

    spiral        around the average camera where all look the same way, else around the scene
    train         along the trajectory of the recording, or from photo to photo
    exposure:N    through the exposure of frame N, from when its shutter opens to when it closes

Source of the spiral: Mildenhall et al., *Local Light Field Fusion* (SIGGRAPH 2019).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from sharpfield.core.capture import Capture
from sharpfield.core.device import device_of
from sharpfield.core.errors import OptionError
from sharpfield.geometry.normalise import focus
from sharpfield.geometry.space import average_pose, forward_facing
from sharpfield.geometry.trajectory import Stamped

TURNS = 2
"""How often the spiral goes around."""

SWAY = 0.5
"""The spiral goes to and fro this often for each turn."""

REACH = 90
"""Percentile of the distances from the average camera that the spiral reaches."""

PATHS = "spiral, train, or exposure:N with the number of a frame"


@dataclass(frozen=True)
class CameraPath:
    """Where and when to render each image of a video."""

    poses: Float32[np.ndarray, "n 3 4"]
    """World-from-camera."""
    time: Float32[np.ndarray, "n"]
    """0...1 of the capture."""

    def __len__(self) -> int:
        """Number of images."""
        return len(self.time)


def camera_path(capture: Capture, path: str, *, images: int = 60) -> CameraPath:
    """The path of a name.

    Args:
        capture: In the space to render in: a model's own capture.
        path: `spiral`, `train` or `exposure:N`.
        images: How many.

    Raises:
        OptionError: There is no such path, or the capture does not have it.
    """
    if images < 1:
        raise OptionError("a path needs at least one image", got=images)
    kind, _, argument = path.partition(":")
    if kind == "exposure" and argument.isdecimal():
        return within_exposure(capture, int(argument), images)
    makers: dict[str, Callable[[Capture, int], CameraPath]] = {"spiral": spiral, "train": along}
    if path not in makers:
        raise OptionError("unknown camera path", got=path, do=f"use {PATHS}")
    return makers[path](capture, images)


def spiral(capture: Capture, images: int) -> CameraPath:
    """Around what is seen, while time runs through the capture.

    Where all cameras look roughly the same way, LLFF's spiral around the average camera, as wide
    as the cameras stand apart; else a circle around the point that they look at.
    """
    poses = _seen_from(capture)
    angle = np.linspace(0, 2 * math.pi * TURNS, images, endpoint=False)
    target = None if forward_facing(poses) else focus(poses)
    if target is None:
        made = _spiral(poses, angle, capture.near, capture.far)
    else:
        made = _circle(poses, target, angle / TURNS)
    time = np.linspace(0, 1, images) if images > 1 else np.full(1, 0.5)
    return CameraPath(made.astype(np.float32), time.astype(np.float32))


def along(capture: Capture, images: int) -> CameraPath:
    """Along the recording: evenly in time if the camera's motion is known, else photo to photo."""
    known = capture.trajectory.known_us(0)
    if known is not None:
        return _on_track(capture, _between(capture, *known, images), 0)
    train, exposure = capture.split.train, capture.needed_frames.exposure
    stamps, poses = exposure.middle_us[train], _frame_poses(capture, train)
    # Between photos in no particular order a curve would swing wildly; lines stay among them.
    through = Stamped(stamps, poses, capture.clock, translation="linear")
    time = _between(capture, int(stamps[0]), int(stamps[-1]), images).astype(np.float32)
    made = through.pose(torch.from_numpy(time), torch.zeros(images).long())
    return CameraPath(made.numpy(), time)


def within_exposure(capture: Capture, frame: int, images: int) -> CameraPath:
    """Through the exposure of one frame, both ends included.

    Raises:
        OptionError: There is no such frame, or it was taken in one instant.
    """
    frames = capture.needed_frames
    if frame >= len(frames):
        raise OptionError(
            "no such frame", got=frame, do=f"use a number from 0 to {len(frames) - 1}"
        )
    if frames.exposure.instant[frame]:
        raise OptionError(
            "nothing moves within this exposure: it is one instant",
            where=f"frame {frames.names[frame]}",
            do="choose a frame that was exposed for a while, or another path",
        )
    opens, closes = frames.exposure.open_us[frame], frames.exposure.close_us[frame]
    time = _between(capture, int(opens), int(closes), images)
    return _on_track(capture, time, int(frames.track[frame]))


def _spiral(
    poses: Float[np.ndarray, "n 3 4"], angle: Float[np.ndarray, "m"], near: float, far: float
) -> Float[np.ndarray, "m 3 4"]:
    middle = average_pose(poses)
    aside = (poses[:, :, 3] - middle[:, 3]) @ middle[:, :3]  # in axes of the average camera
    reach = np.percentile(np.abs(aside), REACH, axis=0)
    # LLFF looks at a depth between 0.9 near and 5 far, three quarters of the way in disparity.
    depth = 1 / (0.25 / (0.9 * near) + 0.75 / (5 * far))
    offset = reach * np.stack([np.cos(angle), np.sin(angle), np.sin(SWAY * angle)], -1)
    centre = middle[:, 3] + offset @ middle[:, :3].T
    target = middle[:, 3] + depth * middle[:, 2]
    return _looking(centre, target, middle[:, 1])


def _circle(
    poses: Float[np.ndarray, "n 3 4"],
    target: Float[np.ndarray, "3"],
    angle: Float[np.ndarray, "m"],
) -> Float[np.ndarray, "m 3 4"]:
    """Around the vertical through the target, at the cameras' mean height and distance."""
    down = poses[:, :, 1].sum(0)
    down = down / np.linalg.norm(down)
    from_target = poses[:, :, 3] - target
    height = from_target @ down
    radius = np.linalg.norm(from_target - height[:, None] * down, axis=-1).mean()
    first = from_target[0] - height[0] * down
    first = first / np.linalg.norm(first)
    around = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(down, first)
    return _looking(target + height.mean() * down + radius * around, target, down)


def _looking(
    centre: Float[np.ndarray, "m 3"], target: Float[np.ndarray, "3"], down: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "m 3 4"]:
    """Poses at some places that look at a point, with the horizon level."""
    forward = target - centre
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(down, forward)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward, centre], -1)


def _seen_from(capture: Capture) -> Float[np.ndarray, "n 3 4"]:
    """Poses of the training frames; without frames, poses along the trajectory."""
    if capture.frames is not None:
        chosen = capture.split.train if len(capture.split.train) else np.arange(len(capture.frames))
        return _frame_poses(capture, chosen)
    return along(capture, 100).poses.astype(np.float64)


def _frame_poses(capture: Capture, frames: Int64[np.ndarray, "m"]) -> Float[np.ndarray, "m 3 4"]:
    held = capture.needed_frames
    time = capture.clock.unit(held.exposure.middle_us[frames])
    return _poses(capture, time, held.track[frames]).astype(np.float64)


def _between(capture: Capture, first_us: int, last_us: int, images: int) -> Float[np.ndarray, "n"]:
    first, last = capture.clock.unit(np.array([first_us, last_us]))
    return np.linspace(first, last, images)


def _on_track(capture: Capture, time: Float[np.ndarray, "n"], track: int) -> CameraPath:
    tracks = np.full(len(time), track)
    return CameraPath(_poses(capture, time, tracks), time.astype(np.float32))


@torch.no_grad()
def _poses(
    capture: Capture, time: Float[np.ndarray, "n"], track: Int64[np.ndarray, "n"]
) -> Float32[np.ndarray, "n 3 4"]:
    home = device_of(capture.trajectory)
    at = torch.from_numpy(time).float().to(home), torch.from_numpy(track).to(home)
    return capture.trajectory.pose(*at).float().cpu().numpy()
