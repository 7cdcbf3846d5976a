import pytest

from sharpfield.captures.native import layout as native
from sharpfield.captures.native.layout import write
from sharpfield.captures.read import LAYOUTS, layout_of, read
from sharpfield.captures.writers import llff_events as write_llff_events
from sharpfield.core.errors import CaptureError, OptionError


def test_a_capture_is_recognised_by_its_files(panning, tmp_path):
    write(panning, tmp_path / "a")
    write_llff_events.write(panning, tmp_path / "b")
    assert layout_of(tmp_path / "a") == "native"
    assert layout_of(tmp_path / "b") == "ev-deblur-nerf"
    assert read(tmp_path / "a").name == panning.name
    assert read(str(tmp_path / "b")).name == "b"


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
    with pytest.raises(CaptureError, match="no known layout") as caught:
        read(tmp_path)
    message = str(caught.value)
    assert "got    holiday.mp4" in message
    for name, layout in LAYOUTS.items():
        assert f"{layout.marks} ({name})" in message


def test_a_path_that_is_no_folder(tmp_path):
    with pytest.raises(CaptureError, match="capture not found"):
        read(tmp_path / "garden")
    (tmp_path / "events.h5").touch()
    with pytest.raises(CaptureError, match="a capture is a folder, not a file"):
        read(tmp_path / "events.h5")


def test_options_that_do_not_fit(panning, tmp_path):
    native.write(panning, tmp_path)
    with pytest.raises(OptionError, match="unknown layout") as caught:
        read(tmp_path, layout="nerf")
    assert "use one of native, ev-deblur-nerf" in str(caught.value)
    with pytest.raises(OptionError, match="layout native has no option event_unit") as caught:
        read(tmp_path, event_unit="ns")
    assert "it belongs to ev-deblur-nerf" in str(caught.value)
    with pytest.raises(CaptureError, match="unknown image encoding"):
        read(tmp_path, encoding="rec709")
