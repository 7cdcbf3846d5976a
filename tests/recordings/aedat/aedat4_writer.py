"""Writing AEDAT4: a recording as DV would have saved it.

Stream 0 holds events, stream 1 frames with their exposures, stream 2 triggers, each only if there
are any. Packets follow each other in the order of time, so that a reader can play the file. The
table of packets is left out; DV makes it anew. Layout: see `recordings.aedat4`.
"""

import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from heapq import merge
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, checked
from sharpfield.core.files import replacing
from sharpfield.recordings.aedat.aedat4 import EDGES, EVENT, FIRST_LINE, PIXELS
from sharpfield.recordings.recording import Frame, Recording, Triggers
from tests.recordings.aedat.flatbuffer_writer import Scalar, Tables, Vector, packed

PACKET = 2**14
"""Most events in a packet, as DV has it about."""

EVENTS, FRAMES, TRIGGERS = 0, 1, 2

Packing = Literal["none", "lz4", "zstd"]


class _Packet(NamedTuple):
    begin_us: int
    stream: int
    data: bytes


def write_aedat4(path: Path, recording: Recording, *, packing: Packing = "lz4") -> None:
    """Write all that a recording holds; a file at `path` is replaced.

    Args:
        path: Of the file.
        recording: Of any layout; it is read piece by piece. Raw colour is written as grey.
        packing: How packets are compressed; "none" needs no package.

    Raises:
        CaptureError: Events are unsound, or an image is neither grey nor RGB.
    """
    pack = _PACKERS[packing]()
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(FIRST_LINE + _header(recording, packing))
        for packet in merge(*_packets(recording, path), key=lambda packet: packet.begin_us):
            _write(file, packet.stream, pack(packet.data))


def _packets(recording: Recording, path: Path) -> Iterator[Iterator[_Packet]]:
    if recording.events is not None:
        yield _event_packets(recording, path)
    if recording.frames is not None:
        yield _frame_packets(recording.frames, path)
    if recording.triggers is not None:
        yield _trigger_packets(recording.triggers())


def _event_packets(recording: Recording, path: Path) -> Iterator[_Packet]:
    for chunk in recording.chunks():
        checked(chunk, path)
        if chunk.rectified:
            raise CaptureError("AEDAT4 holds whole pixels, not rectified events", where=path)
        for first in range(0, len(chunk), PACKET):
            part = chunk[first : first + PACKET]
            yield _Packet(int(part.t_us[0]), EVENTS, _packed_events(part))


def _packed_events(part: EventStream) -> bytes:
    stored = np.zeros(len(part), EVENT)
    stored["t"], stored["x"], stored["y"] = part.t_us, part.x, part.y
    stored["on"] = part.p > 0
    return packed("EVTS", [Vector(0, stored.tobytes(), len(part))])


def _frame_packets(frames: Callable[[], Iterator[Frame]], path: Path) -> Iterator[_Packet]:
    for frame in frames():
        height, width, *colours = frame.image.shape
        kinds = [number for number, pixel in PIXELS.items() if pixel == _pixel(frame.image)]
        if not kinds or width > 2**15 - 1 or height > 2**15 - 1:
            raise CaptureError(
                "AEDAT4 holds grey or RGB images of 8 or 16 bits",
                where=path,
                got=f"{frame.image.dtype} of shape {frame.image.shape}",
            )
        image = frame.image[..., ::-1] if colours else frame.image
        pixels = np.ascontiguousarray(image).tobytes()
        parts = [
            Scalar(0, "q", frame.open_us),
            Scalar(1, "q", frame.open_us),
            Scalar(2, "q", frame.close_us),
            Scalar(3, "q", frame.open_us),
            Scalar(4, "q", frame.close_us),
            Scalar(5, "b", kinds[0]),
            Scalar(6, "h", width),
            Scalar(7, "h", height),
            Vector(10, pixels, len(pixels)),
            Scalar(11, "q", frame.close_us - frame.open_us),
        ]
        yield _Packet(frame.open_us, FRAMES, packed("FRME", parts))


def _pixel(image: np.ndarray) -> tuple[str, int]:
    return image.dtype.newbyteorder("<").str.lstrip("|"), (*image.shape, 1)[2]


def _trigger_packets(triggers: Triggers) -> Iterator[_Packet]:
    types = {edge: number for number, edge in reversed(EDGES.items())}
    for t_us, edge, channel in zip(triggers.t_us, triggers.edge, triggers.channel, strict=True):
        number = types.get((int(edge), int(channel)), types[int(edge), 0])
        table = [Scalar(0, "q", int(t_us)), Scalar(1, "b", number)]
        yield _Packet(int(t_us), TRIGGERS, packed("TRIG", [Tables(0, [table])]))


def _write(file: BinaryIO, stream: int, data: bytes) -> None:
    file.write(struct.pack("<ii", stream, len(data)) + data)


def _header(recording: Recording, packing: Packing) -> bytes:
    top = ET.Element("dv", version="2.0")
    outputs = ET.SubElement(top, "node", name="outInfo", path="/outInfo/")
    kinds = [
        (EVENTS, "events", "EVTS", recording.events),
        (FRAMES, "frames", "FRME", recording.frames),
        (TRIGGERS, "triggers", "TRIG", recording.triggers),
    ]
    for number, name, kind, there in kinds:
        if there is None:
            continue
        node = ET.SubElement(outputs, "node", name=str(number), path=f"/outInfo/{number}/")
        _attribute(node, "compression", "string", packing.upper())
        _attribute(node, "originalModuleName", "string", "sharpfield")
        _attribute(node, "originalOutputName", "string", name)
        _attribute(node, "typeDescription", "string", name)
        _attribute(node, "typeIdentifier", "string", kind)
        info = ET.SubElement(node, "node", name="info", path=f"/outInfo/{number}/info/")
        size = recording.size if number != TRIGGERS else None
        for axis, pixels in zip("XY", size or (), strict=False):
            _attribute(info, f"size{axis}", "int", str(pixels))
        _attribute(info, "source", "string", recording.notes.get("camera", "sharpfield"))
    text = ET.tostring(top) + b"\0"
    compression = {"none": 0, "lz4": 1, "zstd": 3}[packing]
    parts = [Scalar(0, "i", compression), Scalar(1, "q", -1), Vector(2, text, len(text) - 1)]
    return packed("IOHE", parts)


def _attribute(node: ET.Element, key: str, kind: str, text: str) -> None:
    ET.SubElement(node, "attr", key=key, type=kind).text = text


def _none() -> Callable[[bytes], bytes]:
    return lambda data: data


def _lz4() -> Callable[[bytes], bytes]:
    frame: Any = import_module("lz4.frame")
    return frame.compress


def _zstd() -> Callable[[bytes], bytes]:
    zstd: Any = import_module("zstandard")
    return zstd.ZstdCompressor(level=1).compress


_PACKERS = {"none": _none, "lz4": _lz4, "zstd": _zstd}
