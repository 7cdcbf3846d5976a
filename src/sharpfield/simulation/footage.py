"""Blurry frames and events from footage of a fast camera: a folder of images, or a video.

Between two images the logarithm of light is taken as linear, which holds only for fast footage: a
few hundred images per second, or motion of less than about a pixel from one to the next.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Int64

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Split
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.frames import Exposure
from sharpfield.geometry.trajectory import Still
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.sensors.frames import FrameSensor, decode
from sharpfield.simulation.static_capture import Recorder

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Endings of image files."""


@dataclass(frozen=True)
class Footage:
    """Sharp images at known times, read when needed."""

    name: str
    times_us: Int64[np.ndarray, "n"]
    images: Callable[[], Iterator[Float32[np.ndarray, "h w 3"]]]
    """Linear RGB 0...1, from the first image to the last."""

    def __post_init__(self) -> None:
        if len(self.times_us) < 2:
            raise CaptureError(
                "footage needs two images at least", where=self.name, got=len(self.times_us)
            )
        back = np.flatnonzero(np.diff(self.times_us) <= 0)
        if len(back):
            raise CaptureError(
                "times of images must ascend",
                where=f"{self.name}, images {back[0]} and {back[0] + 1}",
                got=f"{self.times_us[back[0]]} us, then {self.times_us[back[0] + 1]} us",
            )


def folder_footage(
    folder: Path,
    *,
    per_second: float | None = None,
    times_us: Int64[np.ndarray, "n"] | None = None,
    encoding: str = "srgb",
) -> Footage:
    """A folder of images, in the order of their names.

    Args:
        folder: Where they are.
        per_second: How many were taken per second; or
        times_us: when each was taken.
        encoding: How stored values relate to light, see `core.frames.ENCODINGS`.

    Raises:
        CaptureError: There are no images, or not one time for each.
        OptionError: Neither, or both, of rate and times are given.
    """
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in IMAGES)
    if not files:
        raise CaptureError(
            "no images found", where=folder, do=f"put files there that end in {IMAGES}"
        )
    if (per_second is None) == (times_us is None):
        raise OptionError("give either the rate of the images or their times", where=folder)
    if times_us is None:
        times_us = _even(len(files), per_second)
    if len(times_us) != len(files):
        raise CaptureError(
            "there must be one time for each image",
            where=folder,
            got=f"{len(files)} images, {len(times_us)} times",
        )

    def images() -> Iterator[Float32[np.ndarray, "h w 3"]]:
        for file in files:
            stored = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
            if stored is None:
                raise CaptureError("a image cannot be read", where=file)
            yield _linear(stored, encoding)

    return Footage(folder.name, times_us, images)


def video_footage(
    file: Path, *, per_second: float | None = None, encoding: str = "srgb"
) -> Footage:
    """A video.

    Args:
        file: Anything that OpenCV can decode.
        per_second: How many images were *taken* per second, where the file says how many are to
            be shown (slow motion).
        encoding: How stored values relate to light.

    Raises:
        CaptureError: The file cannot be decoded.
    """
    video = cv2.VideoCapture(str(file))
    count, shown = 0, video.get(cv2.CAP_PROP_FPS)
    while video.grab():  # what the header says of the count is often wrong
        count += 1
    video.release()
    if not count or not (per_second or shown > 0):
        raise CaptureError(
            "not a video that can be decoded", where=file, got=f"{count} images, {shown} per second"
        )

    def images() -> Iterator[Float32[np.ndarray, "h w 3"]]:
        again = cv2.VideoCapture(str(file))
        try:
            for _ in range(count):
                found, stored = again.read()
                if not found:
                    raise CaptureError("the video ends early", where=file)
                yield _linear(stored, encoding)
        finally:
            again.release()

    return Footage(file.stem, _even(count, per_second or shown), images)


def simulate_footage(
    footage: Footage,
    *,
    group: int,
    every: int | None = None,
    frame_sensor: FrameSensor | None = None,
    event_sensor: EventSensor | None = None,
    seed: int = 0,
) -> Capture:
    """Blurry frames and events of footage; poses are unknown.

    Args:
        footage: Sharp images.
        group: How many consecutive images one exposure spans; 1 for sharp frames.
        every: Images from one exposure's start to the next; `group` unless given.
        frame_sensor: How blurry frames are stored.
        event_sensor: What the event pixels are like; ideal unless given.
        seed: Of the sensors' differences and noise.

    Returns:
        A capture whose poses, lens and depth bounds are placeholders; frames have the
        image at mid exposure as their truth.
    """
    every, times = every or group, footage.times_us
    first = np.arange(0, len(times) - group + 1, max(every, 1))
    if group < 1 or every < group or not len(first):
        raise OptionError(
            "images cannot be grouped like this",
            where=footage.name,
            got=f"{len(times)} images in groups of {group}, one every {every}",
        )
    shown = footage.images()
    start = next(shown)
    height, width = start.shape[:2]
    recorder = Recorder(
        (width, height),
        Exposure(times[first], times[first + group - 1]),
        frame_sensor=frame_sensor or FrameSensor(),
        event_sensor=event_sensor or EventSensor(),
        seed=seed,
    )
    for number, (t_us, rgb) in enumerate(zip(times.tolist(), chain([start], shown), strict=True)):
        if rgb.shape[:2] != (height, width):
            raise CaptureError(
                "images have different sizes",
                where=f"{footage.name}, image {number}",
                got=f"{rgb.shape[1]}x{rgb.shape[0]} after {width}x{height}",
            )
        recorder.see(rgb, t_us)
    return Capture(
        camera=Camera(width, height, float(width), float(width), width / 2, height / 2),
        trajectory=Still(np.eye(3, 4)[None]),
        clock=Clock(int(times[0]), int(times[-1] - times[0])),
        near=1.0,
        far=100.0,
        frames=recorder.frames(),
        events=recorder.events(),
        split=Split(np.arange(len(first)), np.zeros(0, np.int64)),
        name=footage.name,
        source="simulation from footage",
        known=replace(recorder.known(), poses="unknown", intrinsics="unknown", bounds="unknown"),
        notes=recorder.notes(),
    )


def _even(count: int, per_second: float | None) -> Int64[np.ndarray, "n"]:
    if per_second is None or not 0 < per_second <= 1e6:
        raise OptionError("images per second must be between 0 and a million", got=per_second)
    return np.rint(np.arange(count) * (1e6 / per_second)).astype(np.int64)


def _linear(
    stored: np.ndarray,  # BGR of 8 or 16 bits, as OpenCV reads it
    encoding: str,
) -> Float32[np.ndarray, "h w 3"]:
    white = np.float32(np.iinfo(stored.dtype).max)
    return np.ascontiguousarray(decode(stored[..., ::-1] / white, encoding))
