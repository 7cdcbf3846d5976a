"""One rule for all formats: however often a recording is read, what was left out counts once."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from sharpfield.recordings.open import FORMATS, open_recording
from sharpfield.recordings.recording import ReaderOptions, ReadLog, Recording
from sharpfield.storage.images import write_image
from tests.recordings import fuzz
from tests.recordings.aedat import test_aedat2, test_aedat3, test_aedat4
from tests.recordings.prophesee import test_dat, test_evt
from tests.recordings.ros import test_recording as test_rosbag
from tests.recordings.tables import test_nmnist
from tests.recordings.tables.test_text import rpg_lines
from tests.recordings.test_video import video
from tests.streams import HEIGHT, WIDTH, random_events

REGISTER = (test_aedat2, test_aedat3, test_aedat4, test_dat, test_evt, test_nmnist, test_rosbag)
"""Modules that make sound files known to `fuzz`."""

EVENTS = random_events(300)
NARROW = (WIDTH - 1, HEIGHT)
"""A size that leaves a few events outside."""

Make = Callable[[Path], Recording]


def truncated(case: str, layout: str) -> Make:
    """A file that ends early."""

    def make(folder: Path) -> Recording:
        path = folder / f"a{fuzz.CASES[case].suffix}"
        path.write_bytes(fuzz.CASES[case].original()[:-3])
        assert layout in FORMATS
        return fuzz.CASES[case].open(path)

    return make


def text(folder: Path) -> Recording:
    (folder / "events.txt").write_text(rpg_lines(300) + "1.0 2 x 1\n")
    return open_recording(folder / "events.txt", ReaderOptions(size=(240, 180)))


def rpg(folder: Path) -> Recording:
    return open_recording(text(folder).path.parent, ReaderOptions(size=(240, 180)))


def columns() -> dict[str, np.ndarray]:
    return {"x": EVENTS.x, "y": EVENTS.y, "t": EVENTS.t_us, "p": EVENTS.p}


def hdf5(folder: Path) -> Recording:
    with h5py.File(folder / "a.h5", "w") as file:
        for name, column in columns().items():
            file[name] = column
    return open_recording(folder / "a.h5", ReaderOptions(size=NARROW, unit="us"))


def npz(folder: Path) -> Recording:
    np.savez(folder / "a.npz", **columns())
    return open_recording(folder / "a.npz", ReaderOptions(size=NARROW, unit="us"))


def npz_folder(folder: Path) -> Recording:
    for i in range(3):
        later = columns() | {"t": EVENTS.t_us + 100_000 * i}
        np.savez(folder / f"{i}.npz", **later)
    return open_recording(folder, ReaderOptions(size=NARROW, unit="us"))


def npy(folder: Path) -> Recording:
    np.save(folder / "a.npy", np.stack(list(columns().values()), -1))
    return open_recording(folder / "a.npy", ReaderOptions(size=NARROW, unit="us", columns="xytp"))


def torn_video(folder: Path) -> Recording:
    path = video(folder / "a.mkv", [40 * i for i in range(30)])
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2 :] = bytes(len(whole) - len(whole) // 2)
    path.write_bytes(whole)
    return open_recording(path)


def images(folder: Path) -> Recording:
    for i in range(3):
        write_image(folder / f"{i}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    return open_recording(folder, ReaderOptions(fps=30.0))


MAKE: dict[str, Make] = {
    "evt": truncated("evt3", "evt"),
    "dat": truncated("dat", "dat"),
    "aedat2": truncated("aedat2", "aedat2"),
    "aedat3": truncated("aedat3", "aedat3"),
    "aedat4": truncated("aedat4-none", "aedat4"),
    "rosbag": truncated("rosbag-ros1", "rosbag"),
    "nmnist": truncated("nmnist", "nmnist"),
    "text": text,
    "rpg-folder": rpg,
    "hdf5": hdf5,
    "npz": npz,
    "npz-folder": npz_folder,
    "npy": npy,
    "video": torn_video,
    "images": images,
}
NEVER = ("video", "images")
"""Formats of which a reading may leave nothing out: it is refused, or ends where decoding ends."""


def read_all(recording: Recording) -> str:
    if recording.events:
        recording.load()
    if recording.frames:
        list(recording.frames())
    if recording.triggers:
        recording.triggers()
    return str(recording.log)


@pytest.mark.parametrize("layout", FORMATS)
def test_reading_again_tells_the_same(tmp_path: Path, layout: str) -> None:
    if layout == "rosbag":
        pytest.importorskip("rosbags")
    recording = MAKE[layout](tmp_path)
    told = read_all(recording)
    assert told or layout in NEVER
    assert read_all(recording) == told
    for start in (recording.events, recording.frames):
        if start:
            next(start(), None)  # a reading that is given up
    assert read_all(recording) == told


def test_readings_beside_each_other() -> None:
    log = ReadLog()
    log.note("odd headers")
    for _ in range(2):
        events, frames = log.start("events"), log.start("frames")
        events.note("truncated ends of the file")
        frames.note("damaged frames", 3)
        frames.note("truncated ends of the file")
        assert log.counts == {
            "odd headers": 1,
            "truncated ends of the file": 1,
            "damaged frames": 3,
        }
    assert not log.start("events").counts
    assert str(log) == "1 odd headers, 3 damaged frames, 1 truncated ends of the file"
