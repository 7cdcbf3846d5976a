"""Choice of the camera model of a capture, and the mapping of frames and events to its pixels.

A capture has one camera: events and frames share its pixels. Where both come through one lens,
nothing is resampled, and the camera model includes the distortion. *Rectified* captures have an
ideal pinhole camera instead: frames are resampled, and events get the undistorted positions of
their pixels. Frames of a second camera are resampled as if they were seen from the event camera;
this is valid for objects that are far away compared with the distance of the two cameras.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Shaped

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Certainty
from sharpfield.core.errors import CaptureError, OptionError, did_you_mean
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.preparation.ingest.options import Optics
from sharpfield.recordings.lens_files import (
    Calibration,
    read_calibration,
    resampling_map,
    undistorted_pixels,
)
from sharpfield.recordings.recording import Recording

Size = tuple[int, int]
"""Width and height in pixels."""

COLOURS = {"R": 0, "G": 1, "B": 2}
DEMOSAIC = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB,
    "GRBG": cv2.COLOR_BayerGRBG2RGB,
    "GBRG": cv2.COLOR_BayerGBRG2RGB,
    "BGGR": cv2.COLOR_BayerBGGR2RGB,
}
"""OpenCV's demosaicing code by colour filter array."""


@dataclass(frozen=True)
class CaptureGeometry:
    """Camera of a capture, and the mapping of images and events to its pixels."""

    camera: Camera
    frame_map: Float32[np.ndarray, "h w 2"] | None = None
    """Position of each pixel in the recorded image; None if images are not resampled."""
    frame_size: Size | None = None
    """Width and height to scale images to; None if they keep their size."""
    pixel_positions: Float32[np.ndarray, "h w 2"] | None = None
    """Position of each event sensor pixel in the capture; None if events keep their pixels."""
    separate_sensors: bool = False
    """Whether frames come from another sensor than events."""
    intrinsics: Certainty = "known"
    notes: dict[str, str | float] = field(default_factory=dict[str, str | float])

    def mapped_image(
        self, image: Shaped[np.ndarray, "y x *c"], bayer: str
    ) -> Shaped[np.ndarray, "h w d"]:
        """Map a recorded image to the pixels of the capture; raw images are demosaiced."""
        if bayer and image.ndim == 2:
            image = cv2.cvtColor(image, DEMOSAIC[bayer])
        if self.frame_map is not None:
            image = cv2.remap(image, *cv2.split(self.frame_map), interpolation=cv2.INTER_LINEAR)
        elif self.frame_size is not None:
            image = cv2.resize(image, self.frame_size, interpolation=cv2.INTER_AREA)
        return image if image.ndim == 3 else image[..., None]

    def mapped_events(self, events: EventStream, bayer: str) -> EventStream:
        """Map events to positions in the capture, with the colours of their filters."""
        if events.rectified:
            return replace(events, bayer=bayer)
        if self.pixel_positions is None:
            x, y = (column.astype(np.uint16, copy=False) for column in (events.x, events.y))
            return replace(events, x=x, y=y, bayer=bayer)
        xy = self.pixel_positions[events.y, events.x]  # [n 2]
        colour = self._site_colour(bayer) if bayer else None
        x, y = np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1])
        return replace(events, x=x, y=y, bayer="", site_colour=colour)

    def _site_colour(self, bayer: str) -> SiteColour:
        assert self.pixel_positions is not None
        height, width = self.pixel_positions.shape[:2]
        tile = np.array([COLOURS[letter] for letter in bayer], np.int8).reshape(2, 2)
        channel = np.tile(tile, (-(-height // 2), -(-width // 2)))[:height, :width]
        x, y = (np.ascontiguousarray(self.pixel_positions[..., i]).ravel() for i in range(2))
        return SiteColour(x, y, np.ascontiguousarray(channel).ravel())


def capture_geometry(
    events: Size | None, frames: Size | None, optics: Optics, where: object
) -> CaptureGeometry:
    """Choose the camera of a capture.

    Args:
        events: Resolution of the event sensor, if there are events.
        frames: Resolution of the recorded images, if there are any.
        optics: Lens calibration.
        where: The recording, for messages.

    Raises:
        CaptureError: Resolutions contradict each other or the calibration.
        OptionError: An option needs a calibration.
    """
    size = events or frames
    assert size is not None, "a recording holds events or frames"
    if optics.calibration is None:
        return _uncalibrated(size, frames or size, optics, where)
    calibration = read_calibration(optics.calibration, size=size)
    name, camera = calibration.camera(optics.camera, optics.calibration)
    _expect_size(camera, size, f"{optics.calibration}, {name}")
    ideal = replace(camera, lens="pinhole", distortion=()) if optics.rectify else camera
    pixel_positions = undistorted_pixels(camera) if ideal != camera and events is not None else None
    if optics.frame_camera is not None and frames is not None:
        second = _second_camera(ideal, calibration, name, frames, optics)
        return replace(second, pixel_positions=pixel_positions)
    if frames is not None and frames != size:
        if not optics.resize:
            raise _two_sizes(size, frames, where)
        camera_of_frames = replace(
            camera.scaled(frames[0] / size[0]), width=frames[0], height=frames[1]
        )
        if ideal != camera:
            frame_map = resampling_map(ideal, camera_of_frames)
            return CaptureGeometry(
                ideal, frame_map, pixel_positions=pixel_positions, separate_sensors=True
            )
        return CaptureGeometry(
            ideal, frame_size=size, pixel_positions=pixel_positions, separate_sensors=True
        )
    return CaptureGeometry(
        ideal,
        resampling_map(ideal, camera) if ideal != camera else None,
        pixel_positions=pixel_positions,
    )


def colour_filter(recording: Recording, given: str | None) -> str:
    """Colour filter array of a recording, unless it is given; "" for none.

    Raises:
        OptionError: It is no known one.
    """
    if given not in (None, "none", *DEMOSAIC):
        raise OptionError(
            "unknown colour filter", got=given, do=did_you_mean(given, ["none", *DEMOSAIC])
        )
    return recording.bayer if given is None else given.replace("none", "")


def empty_stream(size: Size) -> EventStream:
    """An event stream without events."""
    pixels, polarity = np.empty(0, np.uint16), np.empty(0, np.int8)
    return EventStream(pixels, pixels, np.empty(0, np.int64), polarity, *size)


def _uncalibrated(size: Size, frames: Size, optics: Optics, where: object) -> CaptureGeometry:
    if optics.rectify or optics.frame_camera or optics.camera:
        raise OptionError(
            "lenses are not known", where=where, do="give a calibration with --calibration FILE"
        )
    if frames != size and not optics.resize:
        raise _two_sizes(size, frames, where)
    width, height = size
    camera = Camera(width, height, float(width), float(width), width / 2, height / 2)
    return CaptureGeometry(
        camera,
        frame_size=size if frames != size else None,
        separate_sensors=frames != size,
        intrinsics="unknown",
    )


def _second_camera(
    ideal: Camera, calibration: Calibration, name: str, frames: Size, optics: Optics
) -> CaptureGeometry:
    """Frames of a second camera, resampled as seen from the event camera."""
    other, camera = calibration.camera(optics.frame_camera, optics.calibration)
    _expect_size(camera, frames, f"{optics.calibration}, {other}")
    pose = calibration.other_from_camera(name, other)
    if pose is None:
        raise CaptureError(
            "the calibration does not give the relative pose of the two cameras",
            where=optics.calibration,
            got=f"{name} and {other}",
            do="calibrate them together (Kalibr writes T_cn_cnm1)",
        )
    rotation: Float64[np.ndarray, "3 3"] = pose[:3, :3]
    return CaptureGeometry(
        ideal,
        resampling_map(ideal, camera, rotation),
        separate_sensors=True,
        notes={"frame_camera_distance": float(np.linalg.norm(pose[:3, 3]))},
    )


def _expect_size(camera: Camera, size: Size, where: str) -> None:
    if camera.size != size:
        raise CaptureError(
            "the calibration is for another image size",
            where=where,
            got=f"{camera.width}x{camera.height}, recorded {size[0]}x{size[1]}",
            do="name the right camera, or give the calibration of this one",
        )


def _two_sizes(events: Size, frames: Size, where: object) -> CaptureError:
    return CaptureError(
        "frames and events have different sizes",
        where=where,
        got=f"frames {frames[0]}x{frames[1]}, events {events[0]}x{events[1]}",
        do="give --resize if both are behind one lens, or a calibration of both cameras and"
        " --frame-camera if they are two",
    )
