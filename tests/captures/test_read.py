from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from sharpfield.captures.layout import Layout, ReadOptions
from sharpfield.captures.native import layout as native
from sharpfield.captures.native.layout import write
from sharpfield.captures.read import LAYOUTS, layout_of, read_capture
from sharpfield.captures.writers import llff_events as write_llff_events
from sharpfield.core.capture import Capture, Known, Thresholds
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.plugins import PluginWarning


def test_a_capture_is_recognised_by_its_files(panning, tmp_path):
    write(panning, tmp_path / "a")
    write_llff_events.write(panning, tmp_path / "b")
    assert layout_of(tmp_path / "a") == "native"
    assert layout_of(tmp_path / "b") == "ev-deblur-nerf"
    assert read_capture(tmp_path / "a").name == panning.name
    assert read_capture(str(tmp_path / "b")).name == "b"


@pytest.mark.parametrize(
    ("folder", "layout"),
    [
        ("blender/atelier", "ev-deblur-nerf"),
        ("posed/deblurnerf_blurball", "deblur-nerf"),
        ("posed/nerf_synthetic_lego", "nerf-synthetic"),
    ],
)
def test_sample_captures(samples, folder, layout):
    if not (samples / folder).is_dir():
        pytest.skip(f"no {folder} among the sample recordings")
    assert layout_of(samples / folder) == layout


def test_an_unknown_layout_says_what_was_looked_for(tmp_path):
    (tmp_path / "holiday.mp4").touch()
    with pytest.raises(CaptureError, match="unknown layout of a capture") as caught:
        read_capture(tmp_path)
    message = str(caught.value)
    assert "got    holiday.mp4" in message
    for name, layout in LAYOUTS.working().items():
        assert layout.name == name
        assert f"{layout.marks} ({name})" in message


def test_a_path_that_is_no_folder(tmp_path):
    with pytest.raises(CaptureError, match="capture not found"):
        read_capture(tmp_path / "garden")
    (tmp_path / "events.h5").touch()
    with pytest.raises(CaptureError, match="a capture is a folder, not a file"):
        read_capture(tmp_path / "events.h5")


def test_options_that_do_not_fit(panning, tmp_path):
    native.write(panning, tmp_path)
    with pytest.raises(OptionError, match="unknown layout") as caught:
        read_capture(tmp_path, ReadOptions(layout="nerf"))
    assert "did you mean d-nerf?" in str(caught.value)
    with pytest.raises(OptionError, match="layout native has no option event_unit") as caught:
        read_capture(tmp_path, ReadOptions(event_unit="ns"))
    assert "it belongs to ev-deblur-nerf" in str(caught.value)
    with pytest.raises(CaptureError, match="unknown image encoding"):
        read_capture(tmp_path, ReadOptions(encoding="rec709"))


def test_options_for_every_layout_replace_what_is_stored(panning, tmp_path):
    native.write(panning, tmp_path)
    options = ReadOptions(hold_out="last:2", encoding="srgb", threshold=0.3, bounds=(0.5, 20.0))
    found = read_capture(tmp_path, options)
    assert found.split.test.tolist() == [7, 8] and found.needed_frames.encoding == "srgb"
    assert found.known == Known(thresholds=Thresholds(0.3, 0.3))
    assert (found.near, found.far) == (0.5, 20.0)
    assert options.given().keys() == {"hold_out", "encoding", "threshold", "bounds"}


def _single(folder: Path) -> bool:
    return (folder / "single.txt").is_file()


def _read_single(folder: Path, options: ReadOptions) -> Capture:
    return replace(native.read(folder / "inside"), name=options.event_unit or "none")


SINGLE = Layout("single", _single, _read_single, "single.txt", options=("event_unit",))


def test_other_packages_add_layouts_and_a_broken_one_is_a_warning(panning, tmp_path, monkeypatch):
    entries = [
        EntryPoint("single", f"{__name__}:SINGLE", "sharpfield.layouts"),
        EntryPoint("broken", "no.such.module:LAYOUT", "sharpfield.layouts"),
    ]
    monkeypatch.setattr("sharpfield.core.plugins.entry_points", lambda group: entries)
    (tmp_path / "single.txt").touch()
    native.write(panning, tmp_path / "inside")
    with pytest.warns(PluginWarning, match="the entry point broken = no.such.module:LAYOUT"):
        assert layout_of(tmp_path) == "single"
    assert read_capture(tmp_path, ReadOptions(event_unit="us")).name == "us"
    with pytest.raises(OptionError, match="the layout single has no option missing"):
        read_capture(tmp_path, ReadOptions(missing="skip"))
    with pytest.raises(OptionError, match="unknown layout"):
        read_capture(tmp_path, ReadOptions(layout="broken"))
