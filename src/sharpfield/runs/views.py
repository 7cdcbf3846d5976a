"""What a trained model shows at a frame of the capture, or at any pose and time.

Times are whole microseconds on the capture's clock; poses are world-from-camera in the capture's
own world, OpenCV axes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError, ShapeError
from sharpfield.core.rays import Radiance
from sharpfield.core.struct import device_of
from sharpfield.geometry.normalise import change_of
from sharpfield.geometry.rolling import Rolling
from sharpfield.geometry.trajectory import count_tracks
from sharpfield.rendering.view import ViewRenderer, render_view, renderer_of

At = int | Shaped[np.ndarray, "a 4"] | Shaped[Tensor, "a 4"] | None
"""A frame by number; a pose; or None for the camera of the first track."""

TINY_OPACITY = 1e-3
"""Least opacity that depth is divided by."""


@dataclass(frozen=True)
class ViewSpec:
    """A camera that stands still at a pose, or that moves along a track."""

    time_us: float
    """Of the view; of an exposure, its middle. With a rolling shutter, of the first row."""
    exposure_us: float = 0.0
    """The frame's own, where it is one of a frame."""
    track: int = 0
    """Of the capture's trajectory."""
    pose: Float[Tensor, "3 4"] | None = None
    """In the model's world; None to follow the track."""


def view_spec(model: Any, capture: Capture, at: Any, time: float | int | None) -> ViewSpec:
    """The camera that `at` and `time` ask for.

    Args:
        model: Trained.
        capture: As read.
        at: See `At`.
        time: In us on the capture's clock; None for the middle of the frame's exposure, or of the
            capture.

    Raises:
        OptionError: There is no such frame, or the time is outside the capture.
        ShapeError: `at` is not a pose.
    """
    clock = capture.clock
    if time is not None and not clock.origin_us <= time <= clock.origin_us + clock.span_us:
        raise OptionError(
            "the time is outside the capture",
            where=capture.name,
            got=f"{time} us",
            do=f"use {clock.origin_us} to {clock.origin_us + clock.span_us} us",
        )
    when = clock.origin_us + clock.span_us / 2 if time is None else float(time)
    if at is None:
        return ViewSpec(when)
    if isinstance(at, int | np.integer) and not isinstance(at, bool):
        frames = capture.needed_frames
        if not 0 <= at < len(frames):
            raise OptionError(
                "no such frame", got=at, do=f"use a number from 0 to {len(frames) - 1}"
            )
        exposure = frames.exposure
        own = float(exposure.middle_us[at])
        duration = float(exposure.duration_us[at])
        when = own if time is None else when
        return ViewSpec(when, duration, int(frames.track[at]))
    pose = change_of(model.capture).poses(as_pose(at))
    held = torch.from_numpy(pose).float().to(device_of(model))
    return ViewSpec(when, pose=held)


def as_pose(values: Any) -> Float[np.ndarray, "3 4"]:
    """A pose from an array of shape (3, 4) or (4, 4).

    Raises:
        ShapeError: It has another shape, is not finite, or its left part is not a rotation.
    """
    got, wanted = type(values).__name__, "a frame's number, or a pose of shape (3, 4) or (4, 4)"
    try:
        pose = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, float)
    except (TypeError, ValueError):
        raise ShapeError("this says no viewpoint", got=got, do=f"give {wanted}") from None
    if pose.shape not in ((3, 4), (4, 4)):
        raise ShapeError("a pose has another shape", got=str(pose.shape), do=f"give {wanted}")
    rotation = pose[:3, :3]
    if not np.isfinite(pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise ShapeError(
            "a pose is not a rotation beside a position",
            got=np.array2string(pose, precision=3).replace("\n", ""),
            do="give world-from-camera: x right, y down, z forward",
        )
    return pose[:3]


def radiance(model: Any, capture: Capture, camera: ViewSpec) -> Radiance:
    """Sharp linear light of one instant, `[h, w]`, on the CPU.

    Raises:
        OptionError: The trajectory has no such track.
    """
    own = model.capture
    unit = float(np.clip(own.clock.unit(round(camera.time_us)), 0, 1))
    if camera.pose is not None:
        return render_view(renderer_of(model), own.camera, camera.pose, unit)
    if camera.track >= count_tracks(capture.trajectory):
        raise OptionError("no such camera track", where=capture.name, got=camera.track)
    home = device_of(own.trajectory)
    when = torch.tensor(unit, device=home), torch.tensor(camera.track, device=home)
    with torch.no_grad():
        shutter = Rolling.of(capture, along=own.trajectory)
        pose, rows = shutter.pose(*when), shutter.rows(*when)
    rows = None if rows is None else rows.to(device_of(model))
    return render_view(renderer_of(model), own.camera, pose.to(device_of(model)), unit, rows=rows)


def mean_light(
    model: Any, capture: Capture, camera: ViewSpec, samples: int
) -> Float[Tensor, "h w c"]:
    """Linear light gathered during an exposure: the mean of sharp views, evenly spread in time.

    Raises:
        OptionError: There are no samples, or the exposure is shorter than nothing.
    """
    if camera.exposure_us < 0 or samples < 1:
        raise OptionError(
            "an exposure has a length of 0 us or more, and is the mean of at least one view",
            got=f"{camera.exposure_us} us, {samples} samples",
        )
    count = samples if camera.exposure_us else 1
    parts = (np.arange(count) + 0.5) / count - 0.5  # middles of equal parts, -0.5...0.5
    times = camera.time_us + camera.exposure_us * parts
    views = [
        ViewSpec(time, track=camera.track, pose=camera.pose)  # each an instant
        for time in times.tolist()
    ]
    return torch.stack([radiance(model, capture, one).rgb for one in views]).mean(0)


def encoded(model: Any, light: Float[Tensor, "h w c"]) -> Float[np.ndarray, "h w 3"]:
    """Light as the frames would store it, 0...1; grey is repeated over three channels."""
    with torch.no_grad():
        stored = model.encode(light.to(device_of(model))).clamp(0, 1).float().cpu()
    return stored.expand(-1, -1, 3).contiguous().numpy()


def depth_along_axis(model: Any, capture: Capture, camera: ViewSpec) -> Float[np.ndarray, "h w"]:
    """Depth along the camera's axis, in units of the capture's world."""
    seen, own = radiance(model, capture, camera), model.capture
    depth = seen.depth
    if not isinstance(renderer_of(model), ViewRenderer):  # distance along each ray, not yet divided
        toward = own.camera.direction(own.camera.grid().double())[..., 2].float()  # [h, w]
        depth = depth / seen.opacity.clamp_min(TINY_OPACITY) * toward
    return (depth / change_of(own).scale).numpy()
