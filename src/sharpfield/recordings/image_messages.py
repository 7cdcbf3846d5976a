"""Images as ROS sends them, plain (`sensor_msgs/Image`) or as PNG or JPEG (`CompressedImage`).

Source: the message definitions of `sensor_msgs`, and `image_encodings.h` for names of pixels.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Shaped

from sharpfield.recordings.bag import Fields, Message, Topic
from sharpfield.recordings.unpacking import Damaged

PLAIN, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"

PIXELS: dict[str, tuple[type[np.unsignedinteger], int, str]] = {
    "mono8": (np.uint8, 1, ""),
    "8UC1": (np.uint8, 1, ""),
    "mono16": (np.uint16, 1, ""),
    "16UC1": (np.uint16, 1, ""),
    "rgb8": (np.uint8, 3, "RGB"),
    "bgr8": (np.uint8, 3, "BGR"),
    "8UC3": (np.uint8, 3, "BGR"),
    "rgba8": (np.uint8, 4, "RGB"),
    "bgra8": (np.uint8, 4, "BGR"),
    "rgb16": (np.uint16, 3, "RGB"),
    "bgr16": (np.uint16, 3, "BGR"),
    **{
        f"bayer_{tile}{bits}": (kind, 1, tile.upper())
        for tile in ("rggb", "bggr", "gbrg", "grbg")
        for bits, kind in (("8", np.uint8), ("16", np.uint16))
    },
}
"""Type and channels of a pixel, and the order of colours, or the tile of filters before them."""


class Image(NamedTuple):
    """A picture and its time."""

    stamp_ns: int
    image: Shaped[np.ndarray, "h w *c"]
    bayer: str


def image(message: Message, topic: Topic) -> Image:
    """The picture of a message.

    Raises:
        Damaged: It is torn, or its pixels are of no known type.
    """
    fields = Fields(message, topic)
    stamp_ns = fields.header_ns()
    if topic.kind == COMPRESSED:
        fields.text()
        return Image(stamp_ns, _unpacked(fields.take(fields.number("I"))), "")
    height, width = fields.number("I"), fields.number("I")
    encoding, big_endian, step = fields.text(), fields.number("B"), fields.number("I")
    data = np.frombuffer(fields.take(fields.number("I")), np.uint8)
    if encoding not in PIXELS:
        raise Damaged(f"pixels of type {encoding!r}")
    kind, channels, colours = PIXELS[encoding]
    row = width * channels * np.dtype(kind).itemsize
    if not (height and width) or row > step or height * step > len(data):
        raise Damaged("a torn image")
    stored = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    pixels = stored.view(np.dtype(kind).newbyteorder(">" if big_endian else "<"))
    found = pixels.astype(kind).reshape(height, width, channels)
    if channels == 1:
        return Image(stamp_ns, found[..., 0], colours)
    return Image(stamp_ns, found[..., :3] if colours == "RGB" else found[..., 2::-1], "")


def _unpacked(data: memoryview) -> Shaped[np.ndarray, "h w *c"]:
    if not len(data):
        raise Damaged("an empty image")
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise Damaged(str(error)) from None
    if found is None or found.dtype not in (np.uint8, np.uint16):
        raise Damaged("no image")
    return found if found.ndim == 2 else np.ascontiguousarray(found[..., 2::-1])
