import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream
from sharpfield.recordings.aedat.aedat2 import open_aedat2
from sharpfield.recordings.recording import ReaderOptions
from tests.recordings import fuzz
from tests.recordings.captured import expect_equal_events

HEADER = "#!AER-DAT2.0\r\n# Timestamps tick is 1 us\r\n# created Tué\r\n"
DAVIS = HEADER + "# AEChip: eu.seebetter.ini.chips.davis.Davis240C\r\n"
DVS128 = HEADER + "# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n"
WIDTH, HEIGHT = 240, 180


def recorded(path: Path, header: str, records: Iterable[tuple[int, int]]) -> Path:
    """A file of addresses and times, one after the other."""
    body = b"".join(struct.pack(">II", address, t & 0xFFFFFFFF) for address, t in records)
    path.write_bytes(header.encode("latin-1") + body)
    return path


def davis_event(x: int, y: int, p: int) -> int:
    """jAER: x from the right, y from below."""
    return (HEIGHT - 1 - y) << 22 | (WIDTH - 1 - x) << 12 | (p > 0) << 11


def davis_sample(x: int, y: int, kind: int, sample: int) -> int:
    """jAER: pixels of frames are not mirrored."""
    return 1 << 31 | (HEIGHT - 1 - y) << 22 | x << 12 | kind << 10 | sample


def dvs128_event(x: int, y: int, p: int) -> int:
    return (127 - y) << 8 | (127 - x) << 1 | (p < 0)


def some_events(count: int, width: int, height: int, last_us: int = 10**6) -> EventStream:
    draw = np.random.default_rng(0)
    return EventStream(
        draw.integers(0, width, count).astype(np.uint16),
        draw.integers(0, height, count).astype(np.uint16),
        np.sort(draw.integers(0, last_us, count)),
        draw.choice(np.array([-1, 1], np.int8), count),
        width,
        height,
    )


def rows(events: EventStream) -> Iterable[tuple[int, int, int, int]]:
    columns = (events.x, events.y, events.t_us, events.p)
    return zip(*(column.tolist() for column in columns), strict=True)


@pytest.mark.parametrize("first", [(0, 0), (239, 0), (0, 179), (239, 179)])
def test_corners_of_a_davis(tmp_path: Path, first: tuple[int, int]) -> None:
    path = recorded(tmp_path / "a.aedat", DAVIS, [(davis_event(*first, 1), 5)])
    read = open_aedat2(path)
    events = read.load()
    assert (read.layout, read.size, read.notes) == ("AEDAT2", (240, 180), {"camera": "Davis240C"})
    assert (events.x[0], events.y[0], events.t_us[0], events.p[0]) == (*first, 5, 1)


def test_addresses_as_published(tmp_path: Path) -> None:
    """By hand: y 3 from below, x 2 from the right, brighter; and of the older camera."""
    path = recorded(tmp_path / "a.aedat", DAVIS, [(0b0_000000011_0000000010_1_00000000000, 1)])
    events = open_aedat2(path).load()
    assert (events.x[0], events.y[0], events.p[0]) == (237, 176, 1)
    path = recorded(tmp_path / "b.aedat", DVS128, [(0b0_0000011_0000010_0, 1), (1, 2)])
    events = open_aedat2(path).load()
    assert (events.x[0], events.y[0], events.p[0]) == (125, 124, 1)
    assert events.p[1] == -1


def test_events_of_a_davis(tmp_path: Path) -> None:
    events = some_events(2000, 240, 180)
    records = [(davis_event(x, y, p), t) for x, y, t, p in rows(events)]
    read = open_aedat2(recorded(tmp_path / "a.aedat", DAVIS, records))
    expect_equal_events(read.load(), events)
    assert not str(read.log)


def test_events_of_a_dvs128(tmp_path: Path) -> None:
    events = some_events(2000, 128, 128)
    records = [(dvs128_event(x, y, p), t) for x, y, t, p in rows(events)]
    path = recorded(tmp_path / "a.aedat", HEADER, records)
    expect_equal_events(open_aedat2(path, ReaderOptions(size=(128, 128))).load(), events)


@pytest.mark.parametrize("block", [1, 7, 64, 1000])
def test_blocks_may_be_cut_anywhere(tmp_path: Path, monkeypatch, block: int) -> None:
    events = some_events(300, 240, 180, last_us=2**33)
    records = [(davis_event(x, y, p), t) for x, y, t, p in rows(events)]
    path = recorded(tmp_path / "a.aedat", DAVIS, records)
    data = path.read_bytes()

    def cut(_: Path, start: int) -> Iterable[bytes]:
        return (data[i : i + block] for i in range(start, len(data), block))

    whole = open_aedat2(path).load()
    monkeypatch.setattr("sharpfield.recordings.aedat.aedat2.read_blocks", cut)
    expect_equal_events(open_aedat2(path).load(), whole)


def test_times_go_on_where_they_wrap(tmp_path: Path) -> None:
    quarters = [i * 2**30 for i in range(4, 9)]
    true = np.array([2**31 - 5, 2**31 + 5, 2**32 - 1, *quarters])
    records = [(davis_event(1, 1, 1), int(t)) for t in true]
    read = open_aedat2(recorded(tmp_path / "a.aedat", DAVIS, records))
    np.testing.assert_array_equal(read.load().t_us, true)


def test_what_is_no_event_is_told_apart(tmp_path: Path) -> None:
    records = [
        (davis_event(4, 5, 1), 10),
        (1 << 10, 11),
        (1 << 31 | 3 << 10 | 77 << 12, 12),
        (davis_event(4, 5, -1) | 511 << 22, 13),
        (davis_event(4, 6, -1), 14),
    ]
    read = open_aedat2(recorded(tmp_path / "a.aedat", DAVIS, records))
    np.testing.assert_array_equal(read.load().t_us, [10, 14])
    assert read.log.counts == {"words of IMU samples": 1, "events outside the sensor": 1}
    triggers = read.triggers()
    assert (triggers.t_us.tolist(), triggers.edge.tolist()) == ([11], [1])
    records = [(dvs128_event(4, 5, 1), 10), (1 << 15, 11), (1 << 20, 12)]
    read = open_aedat2(recorded(tmp_path / "b.aedat", DVS128, records))
    assert len(read.load()) == 1 and read.log.counts == {"records of no known kind": 1}
    assert read.triggers().t_us.tolist() == [11]


def frame_records(start_us: int, image: np.ndarray, *, rolling: bool) -> list[tuple[int, int]]:
    """Readings of a frame, column by column from the right, a us each."""

    def column(x: int, kind: int, t: int) -> list[tuple[int, int]]:
        samples = 800 - (image[:, x] if kind else np.zeros(HEIGHT, int))
        return [(davis_sample(x, y, kind, int(v)), t) for y, v in enumerate(samples)]

    order = range(WIDTH - 1, -1, -1)
    resets = [(start_us + i, x, 0) for i, x in enumerate(order)]
    late = 40 if rolling else 5000
    signals = [(start_us + late + i, x, 1) for i, x in enumerate(order)]
    steps = sorted(resets + signals, key=lambda step: (step[0], step[2]))
    return [record for t, x, kind in steps for record in column(x, kind, t)]


@pytest.mark.parametrize(("rolling", "opened", "closed"), [(False, 239, 5000), (True, 0, 40)])
def test_frames_and_their_exposures(tmp_path: Path, rolling, opened, closed) -> None:
    images = np.random.default_rng(0).integers(0, 700, (2, HEIGHT, WIDTH))
    records = [(davis_event(0, 0, 1), 1)]
    records += frame_records(1000, images[0], rolling=rolling)
    records += frame_records(30_000, images[1], rolling=rolling)
    read = open_aedat2(recorded(tmp_path / "a.aedat", DAVIS, records))
    frames = list(read.frames())
    assert len(frames) == 2 and not str(read.log)
    for frame, image, start_us in zip(frames, images, (1000, 30_000), strict=True):
        np.testing.assert_array_equal(frame.image, image << 6)
        assert (frame.open_us, frame.close_us) == (start_us + opened, start_us + closed)


def test_a_torn_frame_is_counted(tmp_path: Path) -> None:
    image = np.full((HEIGHT, WIDTH), 9)
    records = frame_records(0, image, rolling=False)
    read = open_aedat2(recorded(tmp_path / "a.aedat", DAVIS, records[:-1]))
    assert not list(read.frames())
    assert read.log.counts == {"truncated frames": 1}


def test_a_torn_record_is_counted(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.aedat", DAVIS, [(davis_event(0, 0, 1), 1)] * 3)
    path.write_bytes(path.read_bytes()[:-3])
    read = open_aedat2(path)
    assert len(read.load()) == 2
    assert str(read.log) == "1 truncated records"


def test_the_camera_is_asked_for(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.aedat", HEADER, [(0, 1)])
    with pytest.raises(CaptureError, match="does not state its sensor resolution"):
        open_aedat2(path)
    with pytest.raises(CaptureError) as refused:
        open_aedat2(path, ReaderOptions(size=(320, 240)))
    assert str(refused.value) == (
        "CaptureError: addresses of this camera are not known\n"
        f"  where  {path}\n"
        "  got    320 x 240 pixels, no AEChip in the header\n"
        "  do     give the size of one of the cameras known:"
        " 128 x 128, 240 x 180, 208 x 192, 346 x 260, 640 x 480"
    )


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.aedat").write_bytes(b"#!AER-DAT3.1\r\n")
    with pytest.raises(CaptureError, match="the file is no AEDAT2"):
        open_aedat2(tmp_path / "a.aedat")


def test_the_real_recording(samples: Path) -> None:
    read = open_aedat2(
        samples / "inivation" / "mnist_0_scale04_0001.aedat", ReaderOptions(size=(128, 128))
    )
    events = read.load()
    assert len(events) == 15_744
    assert (events.t_us[0], events.t_us[-1]) == (0, 2_210_588)
    assert (events.p > 0).sum() == 7870
    assert not str(read.log)


def test_polarity_of_the_real_recording_fits_its_motion(samples: Path) -> None:
    """A bright digit wanders over a dark screen: it brightens ahead of itself."""
    read = open_aedat2(
        samples / "inivation" / "mnist_0_scale04_0001.aedat", ReaderOptions(size=(128, 128))
    )
    events = read.load()
    ahead = 0.0
    for start in range(0, 2_000_000, 100_000):
        part = events.window(start, start + 100_000)
        late, bright = part.t_us > start + 50_000, part.p > 0
        for values in (part.x.astype(float), part.y.astype(float)):
            velocity = values[late].mean() - values[~late].mean()
            ahead += velocity * (values[bright].mean() - values[~bright].mean())
    assert ahead > 50


def original() -> bytes:
    events = some_events(400, 240, 180)
    body = [struct.pack(">II", davis_event(x, y, p), t) for x, y, t, p in rows(events)]
    return DAVIS.encode("latin-1") + b"".join(body)


fuzz.register("aedat2", fuzz.Case(original, open_aedat2, ".aedat", most_per_byte=1.0))


def test_damaged_files(tmp_path: Path) -> None:
    outcomes = fuzz.campaign("aedat2", files=200, folder=tmp_path)
    assert outcomes["refused"] and outcomes["partial"]


def test_cameras_by_their_former_names(tmp_path: Path) -> None:
    for chip, size in (("sbret10.SBret10", (240, 180)), ("retina.Tmpdiff128", (128, 128))):
        path = recorded(tmp_path / "a.aedat", HEADER + f"# AEChip: eu.ini.chips.{chip}\n", [])
        assert open_aedat2(path).size == size
