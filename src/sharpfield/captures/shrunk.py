"""Frames at a fraction of their size, for machines with less time."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Shaped

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.frames import Frames


def shrunk(capture: Capture, factor: int) -> Capture:
    """A capture whose frames have a fraction of the width and height.

    Stored values are averaged as they are, which is how published data sets were made smaller.

    Args:
        capture: Frames only; counts of events do not add up over pixels.
        factor: Pixels to each side that become one; what is left over at the border is cut off.

    Raises:
        OptionError: There are events, or the factor is larger than the image.
    """
    frames = capture.needed_frames
    if capture.events is not None:
        raise OptionError(
            "captures with events cannot be made smaller",
            where=capture.name,
            got=f"{len(capture.events)} events",
            do="leave the events out, or use the full size",
        )
    width, height = frames.width // factor, frames.height // factor
    if factor < 1 or not (width and height):
        raise OptionError(
            "frames cannot be made that small",
            where=capture.name,
            got=f"{frames.width}x{frames.height} by {factor}",
        )
    camera = replace(
        capture.camera,
        width=width,
        height=height,
        **{
            name: getattr(capture.camera, name) / factor
            for name in ("fx_px", "fy_px", "cx_px", "cy_px")
        },
    )

    def small(images: Shaped[np.ndarray, "n h w c"]) -> Shaped[np.ndarray, "n y x c"]:
        cut = np.asarray(images)[:, : height * factor, : width * factor]
        resized = [cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA) for one in cut]
        return np.stack(resized).reshape(len(cut), height, width, -1)

    smaller: Frames = replace(
        frames,
        images=small(frames.images),
        truth=None if frames.truth is None else small(frames.truth),
        depth=None,
        flow=None,
    )
    return replace(capture, camera=camera, frames=smaller)
