from importlib.metadata import EntryPoint

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.plugins import PluginWarning
from sharpfield.recordings.open import FORMATS, format_of, open_recording
from sharpfield.recordings.recording import ReaderOptions
from sharpfield.storage.event_writer import write_events
from sharpfield.storage.images import write_image
from tests.streams import HEIGHT, WIDTH, random_events


@pytest.mark.parametrize(
    ("name", "layout", "told", "count", "span"),
    [
        ("prophesee/evt2_sample.raw", "evt", {"size": (640, 480)}, 539_481, 50_000),
        ("prophesee/evt3_sample.raw", "evt", {}, 219_596, 8_801),
        ("prophesee/sample_ncars.dat", "dat", {"size": (304, 240)}, 2_009, 99_952),
        ("inivation/davis346_sample.aedat4", "aedat4", {}, 6_676, 169_941),
        ("inivation/mnist_0_scale04_0001.aedat", "aedat2", {"size": (128, 128)}, 15_744, None),
        ("ros/test_events_1.bag", "rosbag", {}, 343_474, 2_078_178),
        ("ros/test_events_1", "rosbag", {}, 343_474, 2_078_178),
        ("ros/test_events_2", "rosbag", {}, None, None),
        ("ecd_tubrip/boxes_rotation", "rpg-folder", {"size": (240, 180)}, 30_000, 13_279),
        ("ecd_tubrip/boxes_rotation/events.txt", "text", {"size": (240, 180)}, 30_000, 13_279),
        (
            "ecd_tubrip/boxes_rotation/events.npy",
            "npy",
            {"size": (240, 180), "unit": "s"},
            29_158,
            13_279,
        ),
        ("ncaltech_nmnist/faces_easy_0001.bin", "nmnist", {"size": (304, 240)}, 67_445, None),
        (
            "blender/atelier/events.h5",
            "hdf5",
            {"size": (300, 200), "unit": "ns"},
            1_820_374,
            1_199_560,
        ),
    ],
)
def test_every_sample_is_recognised_by_what_is_in_it(samples, name, layout, told, count, span):
    path = samples / name
    assert format_of(path) == layout
    found = open_recording(path, ReaderOptions(**told)).load()
    assert count is None or len(found) == count
    assert span is None or found.t_us[-1] - found.t_us[0] == span


def test_samples_without_events(samples):
    assert format_of(samples / "slider_depth_noevents") == "images"
    assert format_of(samples / "video" / "vid2e_seq1.mp4") == "video"


def test_the_name_of_a_file_is_not_believed(tmp_path):
    write_events(tmp_path / "events.raw", random_events(50))
    assert format_of(tmp_path / "events.raw") == "hdf5"
    assert len(open_recording(tmp_path / "events.raw").load()) == 50


def test_every_format_says_what_it_takes():
    for name, known in FORMATS.items():
        assert known.name == name
        assert set(known.options) <= set(vars(ReaderOptions())), name
        assert known.holds and known.marks, name


# Questions


def test_what_fits_no_format(tmp_path):
    (tmp_path / "a.xyz").write_bytes(b"\x00\x01\x02")
    with pytest.raises(CaptureError, match="no known format") as caught:
        open_recording(tmp_path / "a.xyz")
    assert "3 bytes" in str(caught.value) and "AER-DAT4" in str(caught.value)
    with pytest.raises(CaptureError, match="recording not found"):
        open_recording(tmp_path / "b.raw")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match="an empty folder"):
        open_recording(tmp_path / "empty")


def test_what_fits_several_formats(tmp_path):
    (tmp_path / "metadata.yaml").write_text("")
    (tmp_path / "events.txt").write_text("")
    with pytest.raises(CaptureError, match="several formats fit") as caught:
        open_recording(tmp_path)
    assert "choose a layout: rosbag, rpg-folder" in str(caught.value)


def test_what_does_not_belong_to_the_format(tmp_path):
    write_events(tmp_path / "e.h5", random_events(5))
    with pytest.raises(OptionError, match="the format hdf5 has no option columns") as caught:
        open_recording(tmp_path / "e.h5", ReaderOptions(columns="xytp"))
    assert "it belongs to" in str(caught.value) and "npy" in str(caught.value)
    with pytest.raises(OptionError, match="unknown format") as caught:
        open_recording(tmp_path / "e.h5", layout="aedat5")
    assert "did you mean aedat" in str(caught.value)
    write_image(tmp_path / "p" / "0.png", np.zeros((HEIGHT, WIDTH, 1), np.uint8))
    with pytest.raises(CaptureError, match="nothing says when"):
        open_recording(tmp_path / "p")


# Formats of other packages


def test_another_package_adds_a_format_and_a_broken_one_is_only_a_warning(tmp_path, monkeypatch):
    (tmp_path / "their_camera.py").write_text(
        "from sharpfield.recordings.recording import Format, begins_with\n"
        "from sharpfield.recordings.tables.text import open_text\n"
        "FORMAT = Format('their-camera', open_text, 'events', '`#THEIRS`',"
        " recognise=begins_with(b'#THEIRS'), options=('size', 'unit'))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    entries = [
        EntryPoint("their-camera", "their_camera:FORMAT", FORMATS.group),
        EntryPoint("broken", "no_such_package:FORMAT", FORMATS.group),
    ]
    monkeypatch.setattr("sharpfield.core.plugins.entry_points", lambda group: entries)
    path = tmp_path / "a.rec"
    path.write_text("#THEIRS\n0.5 1 2 1\n")
    with pytest.warns(PluginWarning, match="broken = no_such_package:FORMAT"):
        assert format_of(path) == "their-camera"
    assert open_recording(path, ReaderOptions(size=(4, 4))).load().t_us.tolist() == [500_000]
    with pytest.raises(OptionError, match="the format their-camera has no option columns"):
        open_recording(path, ReaderOptions(columns="txyp"))
    write_events(tmp_path / "e.h5", random_events(5))
    assert len(open_recording(tmp_path / "e.h5").load()) == 5
