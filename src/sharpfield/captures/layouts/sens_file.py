"""`.sens` files: a whole ScanNet recording in one file, little endian.

    u32 version (4); u64 length and name of the sensor;
    4 matrices f32 4x4: intrinsics and extrinsics of colour, of depth;
    i32 compression of colour (0 raw, 1 PNG, 2 JPEG) and of depth (0 raw u16, 1 zlib of u16);
    u32 width and height of colour, of depth; f32 steps of depth per metre; u64 number of frames;
    each frame: f32 4x4 world from camera; u64 times of colour and depth in us;
    u64 bytes of colour and of depth; both

The position of each frame follows from the lengths, so frames are decoded one by one.

Source: Dai et al., *ScanNet* (CVPR 2017), description of its sensor files.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8, UInt16

from sharpfield.captures.layout import NO_OPTIONS, Layout, ReadOptions
from sharpfield.captures.layouts._rgbd import RgbdFrames, pinhole, rgbd_capture
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError

VERSION = 4
COLOUR_IMAGES, DEPTH_RAW, DEPTH_ZLIB = (1, 2), 0, 1
"""Supported compressions."""
LONGEST_NAME = 4096
FRAME = struct.Struct("<16fQQQQ")
"""The header of a frame."""


@dataclass(frozen=True)
class SensFile:
    """The positions of all frames in a file."""

    path: Path
    intrinsics: Float64[np.ndarray, "2 4 4"]
    """Of colour and depth."""
    colour_size: tuple[int, int]
    """Width and height."""
    depth_size: tuple[int, int]
    depth_kind: int
    steps_per_metre: float
    poses: Float64[np.ndarray, "n 3 4"]
    """World-from-camera; not finite where tracking failed."""
    offset: Int64[np.ndarray, "n"]
    """Offset of the colour image of each frame, in bytes."""
    lengths: Int64[np.ndarray, "n 2"]
    """Length of colour and depth of each frame, in bytes."""

    def colour(self, frame: int) -> UInt8[np.ndarray, "h w 3"]:
        """Decode the colour image of a frame.

        Raises:
            CaptureError: It cannot be decoded.
        """
        data = self._bytes(int(self.offset[frame]), int(self.lengths[frame, 0]))
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise CaptureError(
                "cannot decode image", where=f"{self.path}, frame {frame}", do="copy the file again"
            )
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def depth(self, frame: int) -> UInt16[np.ndarray, "y x"]:
        """Decode the depth map of a frame, in mm.

        Raises:
            CaptureError: It cannot be decoded.
        """
        start = int(self.offset[frame] + self.lengths[frame, 0])
        data = self._bytes(start, int(self.lengths[frame, 1]))
        width, height = self.depth_size
        try:
            raw = zlib.decompress(data) if self.depth_kind == DEPTH_ZLIB else data
            steps = np.frombuffer(raw, "<u2").reshape(height, width)
        except (zlib.error, ValueError) as error:
            raise CaptureError(
                "cannot decode depth",
                where=f"{self.path}, frame {frame}",
                got=error,
                do="copy the file again",
            ) from None
        if self.steps_per_metre == 1000:
            return steps.astype(np.uint16)
        metres = steps / self.steps_per_metre
        return np.rint(1000 * metres).clip(0, np.iinfo(np.uint16).max).astype(np.uint16)

    def _bytes(self, start: int, length: int) -> bytes:
        with self.path.open("rb") as file:
            file.seek(start)
            return file.read(length)


def recognise(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return len(list(folder.glob("*.sens"))) == 1


def read(folder: Path, options: ReadOptions = NO_OPTIONS) -> Capture:
    """Read the recording of a folder.

    Args:
        folder: Holds one `.sens` file.
        options: `hold_out`.

    Raises:
        CaptureError: The file is malformed or truncated.
    """
    path = next(iter(sorted(folder.glob("*.sens"))), None)
    if path is None:
        raise CaptureError("there is no .sens file", where=folder, do="it must hold one")
    file = open_sens(path)
    colour, depth = file.intrinsics
    frames = RgbdFrames(
        names=[str(i) for i in range(len(file.offset))],
        poses=file.poses,
        colour=file.colour,
        depth=file.depth,
        measured=file.lengths[:, 1] > 0,
        camera=pinhole(colour, file.colour_size, where=path),
        depth_camera=pinhole(depth, file.depth_size, where=path),
        sources=[path],
        depth_sources=[path],
    )
    return rgbd_capture(frames, options.hold_out, folder=folder, source="sens")


def open_sens(path: Path) -> SensFile:
    """Locate all frames of a file without decoding them.

    Raises:
        CaptureError: The file is malformed or truncated.
    """
    with path.open("rb") as file:
        try:
            return _index(file, path)
        except struct.error:
            raise CaptureError(
                "a .sens file ends too early",
                where=path,
                got=f"{path.stat().st_size} bytes",
                do="copy it again",
            ) from None


def _index(file: BinaryIO, path: Path) -> SensFile:
    version, length = _unpack(file, "<IQ")
    if version != VERSION or length > LONGEST_NAME:
        raise CaptureError(
            "unsupported version of a .sens file",
            where=path,
            got=f"version {version}",
            do=f"give one of version {VERSION}",
        )
    file.seek(length, 1)
    matrices = np.array(_unpack(file, "<64f")).reshape(4, 4, 4)
    colour_kind, depth_kind = _unpack(file, "<ii")
    if colour_kind not in COLOUR_IMAGES or depth_kind not in (DEPTH_RAW, DEPTH_ZLIB):
        raise CaptureError(
            "unsupported compression of a .sens file",
            where=path,
            got=f"colour {colour_kind}, depth {depth_kind}",
            do="export it with ScanNet's own reader",
        )
    sizes = _unpack(file, "<IIII")
    steps_per_metre, count = _unpack(file, "<fQ")
    poses, offset, lengths = [], [], []
    end = path.stat().st_size
    for _ in range(count):
        *pose, _, _, colour, depth = FRAME.unpack(file.read(FRAME.size))
        poses.append(np.array(pose).reshape(4, 4)[:3])
        offset.append(file.tell())
        lengths.append((colour, depth))
        if file.tell() + colour + depth > end:
            raise struct.error
        file.seek(colour + depth, 1)
    return SensFile(
        path=path,
        intrinsics=matrices[[0, 2]],
        colour_size=(sizes[0], sizes[1]),
        depth_size=(sizes[2], sizes[3]),
        depth_kind=depth_kind,
        steps_per_metre=float(steps_per_metre),
        poses=np.array(poses, np.float64).reshape(-1, 3, 4),
        offset=np.array(offset, np.int64),
        lengths=np.array(lengths, np.int64).reshape(-1, 2),
    )


def _unpack(file: BinaryIO, layout: str) -> tuple:
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


LAYOUT = Layout("sens", recognise, read, "one .sens file")
