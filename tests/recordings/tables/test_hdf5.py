from collections.abc import Callable

import h5py
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.recording import ReaderOptions
from sharpfield.recordings.tables.columns import open_hdf5
from sharpfield.storage.event_writer import write_events
from tests.recordings import fuzz
from tests.streams import HEIGHT, WIDTH, random_events

SIZE = (WIDTH, HEIGHT)
EVENTS = random_events(500)
EPOCH_US = 1_504_645_177_000_000


def dsec(file: h5py.File) -> None:
    group = file.create_group("events")
    group["x"], group["y"], group["p"] = EVENTS.x, EVENTS.y, (EVENTS.p > 0).astype(np.uint8)
    group["t"] = (EVENTS.t_us - 1000).astype(np.uint32)
    file["t_offset"] = np.int64(1000)
    file["ms_to_idx"] = np.searchsorted(group["t"][:], np.arange(0, 89_000, 1000)).astype(np.uint64)


def flat(file: h5py.File) -> None:
    for name, column in {"x": EVENTS.x, "y": EVENTS.y, "t": EVENTS.t_us, "p": EVENTS.p}.items():
        file[name] = column


def m3ed(file: h5py.File) -> None:
    for camera in ("left", "right"):
        group = file.create_group(f"prophesee/{camera}")
        shifted = EVENTS.t_us + (0 if camera == "left" else 5)
        group["x"], group["y"], group["t"], group["p"] = EVENTS.x, EVENTS.y, shifted, EVENTS.p
        group["calib/resolution"] = np.array(SIZE)
    images = np.arange(3 * 8 * 6, dtype=np.uint8).reshape(3, 6, 8, 1)
    file["ovc/left/data"], file["ovc/right/data"] = images, images + 1
    file["ovc/rgb/data"] = np.concatenate([images, images + 1, images + 2], -1)
    file["ovc/ts"] = np.arange(0, 120_000, 40_000)


def event_utils(file: h5py.File) -> None:
    group = file.create_group("events")
    group["xs"], group["ys"] = EVENTS.x.astype(np.int16), EVENTS.y.astype(np.int16)
    group["ts"], group["ps"] = EVENTS.t_us / 1e6, EVENTS.p > 0
    file.attrs["sensor_resolution"] = (HEIGHT, WIDTH)
    for i in range(3):
        image = file.create_dataset(
            f"images/image{i:09d}", data=np.full((HEIGHT, WIDTH), i, np.uint8)
        )
        image.attrs["timestamp"] = 0.01 * i


def mvsec(file: h5py.File) -> None:
    for camera in ("left", "right"):
        seconds = (EVENTS.t_us + EPOCH_US) / 1e6
        rows = np.stack([EVENTS.x, EVENTS.y, seconds, EVENTS.p], -1)
        file[f"davis/{camera}/events"] = rows.astype(np.float64)
        file[f"davis/{camera}/image_raw"] = np.zeros((2, HEIGHT, WIDTH), np.uint8)
        file[f"davis/{camera}/image_raw_ts"] = np.array([0.0, 0.03]) + EPOCH_US / 1e6


def v2e(file: h5py.File) -> None:
    file["events"] = np.stack([EVENTS.t_us, EVENTS.x, EVENTS.y, EVENTS.p > 0], -1).astype(np.uint32)


def tum_vie(file: h5py.File) -> None:
    dsec(file)
    del file["t_offset"]
    del file["events/t"]
    file["events"].create_dataset("t", data=EVENTS.t_us, compression="gzip", shuffle=True)


def offset_of_one_entry(file: h5py.File) -> None:
    dsec(file)
    del file["t_offset"], file["ms_to_idx"]
    file["t_offset"] = np.array([1000])


def prophesee(file: h5py.File) -> None:
    kind = [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]
    records = np.empty(len(EVENTS), kind)
    columns = (EVENTS.x, EVENTS.y, EVENTS.p > 0, EVENTS.t_us)
    for name, column in zip("xypt", columns, strict=True):
        records[name] = column
    file.create_dataset("CD/events", data=records, chunks=(100,), compression="gzip")
    file.attrs["geometry"] = f"{WIDTH}x{HEIGHT}"


@pytest.mark.parametrize(
    ("write", "layout", "options", "offset_us"),
    [
        (tum_vie, "HDF5", {"size": SIZE}, 0),
        (offset_of_one_entry, "HDF5", {"size": SIZE}, 0),
        (prophesee, "Prophesee HDF5", {}, 0),
        (dsec, "HDF5", {"size": SIZE}, 0),
        (flat, "HDF5", {"size": SIZE, "unit": "us"}, 0),
        (m3ed, "M3ED", {"topic": "left"}, 0),
        (m3ed, "M3ED", {"topic": "right"}, 5),
        (event_utils, "event_utils HDF5", {}, 0),
        (mvsec, "MVSEC", {"topic": "left"}, EPOCH_US),
        (v2e, "v2e HDF5", {"size": SIZE}, 0),
    ],
)
def test_each_dialect_gives_the_same_events(
    tmp_path, write: Callable, layout: str, options: dict, offset_us: int
):
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        write(file)
    recording = open_hdf5(path, ReaderOptions(**options))
    found = recording.load()
    assert recording.layout == layout
    assert recording.size == SIZE
    np.testing.assert_array_equal(found.t_us, EVENTS.t_us + offset_us)
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(EVENTS, name), name)
    assert found.x.dtype == np.uint16


def test_ours_says_everything(tmp_path):
    write_events(tmp_path / "e.h5", EVENTS)
    np.testing.assert_array_equal(open_hdf5(tmp_path / "e.h5").load().t_us, EVENTS.t_us)


def test_frames_of_a_file_that_has_them(tmp_path):
    for write, options in ((event_utils, {}), (mvsec, {"topic": "left"})):
        with h5py.File(tmp_path / "e.h5", "w") as file:
            write(file)
        frames = list(open_hdf5(tmp_path / "e.h5", ReaderOptions(**options)).frames())
        assert [frame.image.shape for frame in frames][:2] == [(HEIGHT, WIDTH)] * 2
        assert frames[1].open_us - frames[0].open_us in (10_000, 30_000)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        v2e(file)
    assert open_hdf5(tmp_path / "e.h5", ReaderOptions(size=SIZE)).frames is None


def test_frames_of_m3ed_are_those_of_the_same_side_unless_told(tmp_path):
    path = tmp_path / "e.h5"
    with h5py.File(path, "w") as file:
        m3ed(file)
    frames = list(open_hdf5(path, ReaderOptions(topic="right")).frames())
    assert [frame.open_us for frame in frames] == [0, 40_000, 80_000]
    np.testing.assert_array_equal(frames[1].image, 49 + np.arange(48).reshape(6, 8))
    (red, green, blue) = next(
        open_hdf5(path, ReaderOptions(topic="left", image_topic="rgb")).frames()
    ).image[0, 0]
    assert (red, green, blue) == (2, 1, 0)
    assert open_hdf5(path, ReaderOptions(topic="left", image_topic="")).frames is None
    with pytest.raises(CaptureError, match="no frames of that camera") as caught:
        open_hdf5(path, ReaderOptions(topic="left", image_topic="middle"))
    assert "left, rgb, right" in str(caught.value)
    with h5py.File(path, "a") as file:
        del file["ovc"]
    assert open_hdf5(path, ReaderOptions(topic="left")).frames is None


# Questions and damage


def test_one_of_several_cameras_has_to_be_named(tmp_path):
    with h5py.File(tmp_path / "e.h5", "w") as file:
        mvsec(file)
    with pytest.raises(CaptureError, match="several cameras") as caught:
        open_hdf5(tmp_path / "e.h5")
    assert "left, right" in str(caught.value)
    with pytest.raises(CaptureError, match="no such camera"):
        open_hdf5(tmp_path / "e.h5", ReaderOptions(topic="middle"))


def test_what_is_no_file_of_events(tmp_path):
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["CD/indexes"] = np.zeros(3)
    with pytest.raises(CaptureError, match="convert Prophesee's own HDF5"):
        open_hdf5(tmp_path / "e.h5", ReaderOptions(size=SIZE))
    (tmp_path / "e.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(CaptureError, match="cannot open the event file"):
        open_hdf5(tmp_path / "e.h5", ReaderOptions(size=SIZE))


def test_no_length_is_believed_that_a_damaged_superblock_tells(tmp_path):
    path = tmp_path / "e.h5"
    data = bytearray(_bytes(dsec)())
    assert data[48:56] == b"\xff" * 8
    data[48:56] = (0xFF).to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="a superblock that goes on elsewhere"):
        open_hdf5(path, ReaderOptions(size=SIZE))


def test_the_size_of_another_sensor_is_refused(tmp_path):
    with h5py.File(tmp_path / "e.h5", "w") as file:
        dsec(file)
    with pytest.raises(CaptureError, match="most events lie outside the sensor") as caught:
        open_hdf5(tmp_path / "e.h5", ReaderOptions(size=(3, 3))).load()
    assert "check the size" in str(caught.value)


def test_a_part_that_cannot_be_unpacked_ends_the_events(tmp_path, monkeypatch):
    monkeypatch.setattr("sharpfield.recordings.tables.columns.CHUNK", 100)
    path = tmp_path / "e.h5"
    with h5py.File(path, "w") as file:
        dsec(file)
        del file["events/t"]
        times = file.create_dataset(
            "events/t", data=(EVENTS.t_us - 1000).astype(np.uint32), chunks=(100,), fletcher32=True
        )
        place = times.id.get_chunk_info(2)
    data = bytearray(path.read_bytes())
    data[place.byte_offset] ^= 0xFF
    path.write_bytes(data)
    recording = open_hdf5(path, ReaderOptions(size=SIZE))
    assert len(recording.load()) == 200
    assert str(recording.log) == "300 events from a damaged part onwards"


def test_the_packing_of_prophesee_needs_its_plugin(tmp_path):
    kind = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    with h5py.File(tmp_path / "e.h5", "w") as file:
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((100,))
        settings.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL, ())
        space = h5py.h5s.create_simple((100,))
        h5py.h5d.create(
            file.create_group("CD").id, b"events", h5py.h5t.py_create(kind), space, settings
        )
    with pytest.raises(CaptureError, match="compressed in a way that cannot be read") as caught:
        open_hdf5(tmp_path / "e.h5", ReaderOptions(size=SIZE))
    assert "Prophesee's ECF" in str(caught.value)


def _bytes(write: Callable) -> Callable[[], bytes]:
    def made() -> bytes:
        with h5py.File("case.h5", "w", driver="core", backing_store=False) as file:
            write(file)
            file.flush()
            return file.id.get_file_image()

    return made


fuzz.register(
    "hdf5-dsec", fuzz.Case(_bytes(dsec), lambda p: open_hdf5(p, ReaderOptions(size=SIZE)), ".h5")
)
fuzz.register(
    "hdf5-m3ed", fuzz.Case(_bytes(m3ed), lambda p: open_hdf5(p, ReaderOptions(topic="left")), ".h5")
)
fuzz.register(
    "hdf5-mvsec",
    fuzz.Case(_bytes(mvsec), lambda p: open_hdf5(p, ReaderOptions(topic="left")), ".h5"),
)


@pytest.mark.parametrize("name", ["hdf5-dsec", "hdf5-mvsec"])
def test_damaged_files_end_well(tmp_path, name):
    outcomes = fuzz.campaign(name, files=60, folder=tmp_path)
    assert outcomes["refused"]


def test_the_sample_of_ev_deblur_nerf(samples):
    path = samples / "blender" / "atelier" / "events.h5"
    with pytest.raises(CaptureError, match="1.2 s if ns"):
        open_hdf5(path, ReaderOptions(size=(300, 200)))
    found = open_hdf5(path, ReaderOptions(size=(300, 200), unit="ns")).load()
    assert len(found) == 1_820_374
