"""Videos: images written one after another to a file or a folder.

`FILE.mp4` holds H.264 in the pixel format that every browser plays; any other path is a folder
that gets one PNG per image. Either appears complete, at the end, or not at all.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import UInt8

from sharpfield.core.errors import OptionError
from sharpfield.core.files import replacing, replacing_folder
from sharpfield.storage.images import list_images, write_image

QUALITY = 18
"""Constant rate factor of x264: visually lossless."""

Image = UInt8[np.ndarray, "h w c"]


class Writer(Protocol):
    """Appends the images of a video in order."""

    def __call__(self, image: Image) -> None:
        """Append one image, RGB or grey."""
        ...


@contextmanager
def video_writer(path: Path, *, fps: float = 30.0) -> Iterator[Writer]:
    """Open a video; gives a function that appends images, all of one size.

    Args:
        path: Ends in `.mp4` for a video; anything without a suffix is a folder of PNGs.
        fps: Frames per second of the video.

    Raises:
        OptionError: Another suffix, fps that are not positive, or a folder with other files.
    """
    if path.suffix.lower() == ".mp4":
        if not fps > 0:
            raise OptionError("a video needs a positive frame rate", got=fps)
        with _mp4(path, fps) as write:
            yield write
    elif path.suffix and not path.is_dir():
        raise OptionError(
            "unknown kind of video", where=path, do="name a file FILE.mp4, or a folder for PNGs"
        )
    else:
        with _folder(path) as write:
            yield write


def write_video(path: Path, images: Iterable[Image], *, fps: float = 30.0) -> int:
    """Write images as they are made; returns their number. See `video_writer`."""
    count = 0
    with video_writer(path, fps=fps) as write:
        for image in images:
            write(image)
            count += 1
    return count


@contextmanager
def _folder(path: Path) -> Iterator[Writer]:
    if path.exists() and not (path.is_dir() and {*path.iterdir()} <= {*list_images(path)}):
        raise OptionError(
            "will not replace a folder that holds other files than images",
            where=path,
            do="choose another folder, or empty it",
        )
    with replacing_folder(path) as temporary:
        count = 0

        def write(image: Image) -> None:
            nonlocal count
            write_image(temporary / f"{count:04d}.png", image)
            count += 1

        yield write


@contextmanager
def _mp4(path: Path, fps: float) -> Iterator[Writer]:
    import av  # only when a video is written
    from av.video.reformatter import Colorspace

    with replacing(path) as temporary:
        with av.open(temporary, "w", options={"movflags": "faststart"}) as file:
            stream = file.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            encoder = stream.codec_context
            encoder.pix_fmt, encoder.options = "yuv420p", {"crf": str(QUALITY)}
            # Colours as players expect them: BT.709 (code 1), limited range (code 1).
            encoder.colorspace = encoder.color_primaries = encoder.color_trc = 1
            encoder.color_range = 1

            def write(image: Image) -> None:
                even = _even(image)
                if not encoder.is_open:
                    stream.height, stream.width = even.shape[:2]
                assert even.shape[:2] == (stream.height, stream.width), "images differ in size"
                frame = av.VideoFrame.from_ndarray(even, format="rgb24")
                frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
                file.mux(stream.encode(frame))

            yield write
            assert encoder.is_open, "a video needs at least one image"
            file.mux(stream.encode())


def _even(image: Image) -> UInt8[np.ndarray, "even_h even_w 3"]:
    """RGB with an even number of rows and columns, as H.264 needs: the last ones are repeated."""
    height, width, _ = image.shape
    rgb = np.broadcast_to(image, (height, width, 3))
    return np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
