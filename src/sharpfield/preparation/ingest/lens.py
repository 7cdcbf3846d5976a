"""Which camera a recording becomes, and what has to be done to its images for that.

A capture has one camera: events and frames share its pixels. Where one lens serves both, nothing
is resampled: the lens is told by the camera's model. *Rectified* captures have an ideal lens
instead: frames are resampled, and events are not, but get the ideal positions of their pixels.
Frames of another camera are resampled as if they were taken from where the events were; this
holds for things that are far compared with the distance of the two.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Shaped

from sharpfield.core.camera import Camera
from sharpfield.core.capture import Certainty
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.recordings.lens_files import (
    Calibration,
    read_calibration,
    resampling_map,
    undistorted_pixels,
)

Size = tuple[int, int]
"""Width and height in pixels."""

COLOURS = {"R": 0, "G": 1, "B": 2}
DEMOSAIC = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB,
    "GRBG": cv2.COLOR_BayerGRBG2RGB,
    "GBRG": cv2.COLOR_BayerGBRG2RGB,
    "BGGR": cv2.COLOR_BayerBGGR2RGB,
}
"""How OpenCV makes RGB of what lies behind a filter tile."""


@dataclass(frozen=True)
class Optics:
    """What is known of lenses."""

    calibration: Path | None = None
    """A file of Kalibr, OpenCV, ROS, DSEC, or RPG's calib.txt. Without one, the focal length is
    only a stand-in until it is found with the poses."""
    camera: str | None = None
    """Name of the event camera in it, where it has several: cam0."""
    frame_camera: str | None = None
    """Name of the camera that took the frames, where it is another one: cam1."""
    rectify: bool = False
    """Remove the distortion of the lens: from frames by resampling, from events by giving them
    positions between pixels."""
    resize: bool = False
    """Scale frames to the size of the event sensor, where both are behind the same lens."""


@dataclass(frozen=True)
class Geometry:
    """The camera of a capture, and how images and events come to its pixels."""

    camera: Camera
    frame_map: Float32[np.ndarray, "h w 2"] | None = None
    """Where each pixel lies in the recorded image; None if images stay as they are."""
    frame_size: Size | None = None
    """To scale images to."""
    sites: Float32[np.ndarray, "h w 2"] | None = None
    """Position of each pixel of the event sensor; None if events keep their pixels."""
    separate: bool = False
    """Whether frames come from another sensor than events."""
    intrinsics: Certainty = "known"
    notes: dict[str, str | float] = field(default_factory=dict[str, str | float])

    def image(self, image: Shaped[np.ndarray, "y x *c"], bayer: str) -> Shaped[np.ndarray, "h w d"]:
        """A recorded image on the capture's pixels; of a colour sensor, with its colours."""
        if bayer and image.ndim == 2:
            image = cv2.cvtColor(image, DEMOSAIC[bayer])
        if self.frame_map is not None:
            image = cv2.remap(image, *cv2.split(self.frame_map), interpolation=cv2.INTER_LINEAR)
        elif self.frame_size is not None:
            image = cv2.resize(image, self.frame_size, interpolation=cv2.INTER_AREA)
        return image if image.ndim == 3 else image[..., None]

    def placed(self, events: EventStream, bayer: str) -> EventStream:
        """Events at the positions that the capture has them at, and behind its colour filter."""
        if events.rectified:
            return replace(events, bayer=bayer)
        if self.sites is None:
            x, y = (column.astype(np.uint16, copy=False) for column in (events.x, events.y))
            return replace(events, x=x, y=y, bayer=bayer)
        place = self.sites[events.y, events.x]
        colour = self._site_colour(bayer) if bayer else None
        x, y = np.ascontiguousarray(place[:, 0]), np.ascontiguousarray(place[:, 1])
        return replace(events, x=x, y=y, bayer="", site_colour=colour)

    def _site_colour(self, bayer: str) -> SiteColour:
        assert self.sites is not None
        height, width = self.sites.shape[:2]
        tile = np.array([COLOURS[letter] for letter in bayer], np.int8).reshape(2, 2)
        channel = np.tile(tile, (-(-height // 2), -(-width // 2)))[:height, :width]
        x, y = (np.ascontiguousarray(self.sites[..., i]).ravel() for i in range(2))
        return SiteColour(x, y, np.ascontiguousarray(channel).ravel())


def geometry(events: Size | None, frames: Size | None, optics: Optics, where: object) -> Geometry:
    """Decide on the camera.

    Args:
        events: Size of the event sensor, if there are events.
        frames: Size of the recorded images, if there are any.
        optics: What is known of the lenses.
        where: The recording, for messages.

    Raises:
        CaptureError: Sizes do not fit each other, or the calibration.
        OptionError: An option needs a calibration.
    """
    size = events or frames
    assert size is not None, "a recording holds events or frames"
    if optics.calibration is None:
        return _uncalibrated(size, frames or size, optics, where)
    known = read_calibration(optics.calibration, size=size)
    name, camera = known.camera(optics.camera, optics.calibration)
    _expect_size(camera, size, f"{optics.calibration}, {name}")
    ideal = replace(camera, lens="pinhole", distortion=()) if optics.rectify else camera
    sites = undistorted_pixels(camera) if ideal != camera and events is not None else None
    if optics.frame_camera is not None and frames is not None:
        made = _from_beside(ideal, known, name, frames, optics)
        return replace(made, sites=sites)
    if frames is not None and frames != size:
        if not optics.resize:
            raise _two_sizes(size, frames, where)
        camera_of_frames = replace(
            camera.scaled(frames[0] / size[0]), width=frames[0], height=frames[1]
        )
        if ideal != camera:
            frame_map = resampling_map(ideal, camera_of_frames)
            return Geometry(ideal, frame_map, sites=sites, separate=True)
        return Geometry(ideal, frame_size=size, sites=sites, separate=True)
    return Geometry(ideal, resampling_map(ideal, camera) if ideal != camera else None, sites=sites)


def no_events(size: Size) -> EventStream:
    """A stream of a sensor that reported nothing."""
    pixels, polarity = np.empty(0, np.uint16), np.empty(0, np.int8)
    return EventStream(pixels, pixels, np.empty(0, np.int64), polarity, *size)


def _uncalibrated(size: Size, frames: Size, optics: Optics, where: object) -> Geometry:
    if optics.rectify or optics.frame_camera or optics.camera:
        raise OptionError(
            "lenses are not known", where=where, do="give a calibration with --calibration FILE"
        )
    if frames != size and not optics.resize:
        raise _two_sizes(size, frames, where)
    width, height = size
    camera = Camera(width, height, float(width), float(width), width / 2, height / 2)
    return Geometry(
        camera,
        frame_size=size if frames != size else None,
        separate=frames != size,
        intrinsics="unknown",
    )


def _from_beside(
    ideal: Camera, known: Calibration, name: str, frames: Size, optics: Optics
) -> Geometry:
    """Frames of another camera, seen from where the events were."""
    other, camera = known.camera(optics.frame_camera, optics.calibration)
    _expect_size(camera, frames, f"{optics.calibration}, {other}")
    pose = known.other_from_camera(name, other)
    if pose is None:
        raise CaptureError(
            "the calibration does not say how the two cameras stand to each other",
            where=optics.calibration,
            got=f"{name} and {other}",
            do="calibrate them together (Kalibr writes T_cn_cnm1)",
        )
    turn: Float64[np.ndarray, "3 3"] = pose[:3, :3]
    return Geometry(
        ideal,
        resampling_map(ideal, camera, turn),
        separate=True,
        notes={"frame_camera_distance": float(np.linalg.norm(pose[:3, 3]))},
    )


def _expect_size(camera: Camera, size: Size, where: str) -> None:
    if camera.size != size:
        raise CaptureError(
            "the calibration is of another size of image",
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
