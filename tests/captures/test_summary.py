import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.native.layout import write
from sharpfield.captures.summary import capture_summary, path_summary
from sharpfield.captures.writers import llff_events as write_llff_events
from sharpfield.core.capture import Known
from sharpfield.core.errors import CaptureError
from sharpfield.storage.event_writer import write_events


def write_flat(path, events, factor=1):
    columns = {"x": events.x, "y": events.y, "t": events.t_us * factor, "p": events.p}
    if path.suffix == ".npz":
        np.savez(path, **columns)
        return
    with h5py.File(path, "w") as file:
        for name, column in columns.items():
            file[name] = column


def test_a_capture(panning, tmp_path):
    write(panning, tmp_path / "panning")
    about = path_summary(tmp_path / "panning")
    assert about["kind"] == "capture" and about["name"] == panning.name
    events, frames = about["events"], about["frames"]
    assert events["count"] == 5_000
    assert events["on"] + events["off"] == 5_000
    assert events["on"] == (panning.events.p > 0).sum()
    assert (events["width"], events["height"]) == (12, 10)
    assert events["t_first_us"] == panning.events.t_us[0]
    assert events["t_last_us"] == panning.events.t_us[-1]
    seconds = (panning.events.t_us[-1] - panning.events.t_us[0]) / 1e6
    assert events["rate_per_s"] == pytest.approx(5_000 / seconds)
    assert (frames["count"], frames["blurry"], frames["sharp"]) == (9, 7, 2)
    assert (frames["width"], frames["height"], frames["bits"]) == (12, 10, 8)
    assert frames["exposure_us"] == {"least": 8_000, "median": 8_000, "most": 8_000}
    assert about["split"] == {"train": 7, "test": 2, "test_frames": ["00", "08"]}
    assert about["trajectory"]["t_last_us"] == 100_000
    assert about["bounds"] == {"near": 0.7, "far": 9.1}


def test_the_path_is_as_long_as_it_is(panning):
    times = np.linspace(0, 0.25, 10_001)
    centres = np.stack([times, 0.5 * times**2, -times], -1)
    length = np.linalg.norm(np.diff(centres, axis=0), axis=-1).sum()
    assert capture_summary(panning)["trajectory"]["path_length"] == pytest.approx(length, rel=1e-4)


def test_everything_is_plain_json(panning, tmp_path):
    noted = replace(panning, notes={"threshold_on": 0.2, "map": np.zeros((10, 12))})
    write(noted, tmp_path / "panning")
    about = path_summary(tmp_path / "panning")
    assert json.loads(json.dumps(about, allow_nan=False)) == about
    assert about["notes"] == {"threshold_on": 0.2, "map": "array (10, 12)"}


def test_photos_of_unknown_motion_are_neither_blurry_nor_sharp(panning):
    frames = capture_summary(replace(panning, known=Known(motion="unknown")))["frames"]
    assert frames["count"] == 9 and frames["blurry"] is None and frames["sharp"] is None


def test_a_file_of_events(tmp_path, some_events):
    events = some_events(2_000)
    write_events(tmp_path / "events.h5", events)
    about = path_summary(tmp_path / "events.h5")
    assert about["kind"] == "events"
    assert about["events"]["count"] == 2_000
    assert about["events"]["on"] == (events.p > 0).sum()
    assert about["events"]["t_last_us"] == events.t_us[-1]
    assert (about["events"]["width"], about["events"]["height"]) == (12, 10)
    assert about["events"]["unit"] == "us" and about["events"]["size_from"] == "file"


@pytest.mark.parametrize("name", ["events.h5", "events.npz"])
def test_a_file_that_does_not_state_its_unit(tmp_path, some_events, name):
    events = some_events(2_000)
    write_flat(tmp_path / name, events, factor=1_000)
    about = path_summary(tmp_path / name)["events"]
    assert about["unit"] is None and about["t_first_us"] is None and about["rate_per_s"] is None
    assert (about["t_first"], about["t_last"]) == tuple(events.t_us[[0, -1]] * 1_000)
    assert (about["width"], about["height"]) == (12, 10)
    assert about["size_from"] == "largest coordinates"
    told = path_summary(tmp_path / name, ReadOptions(event_unit="ns"))["events"]
    assert told["t_last_us"] == events.t_us[-1]


def test_the_events_of_a_capture_have_the_unit_of_its_layout(panning, tmp_path):
    write_llff_events.write(panning, tmp_path / "scene")
    write_flat(tmp_path / "scene" / "events.h5", panning.events, factor=1_000)
    about = path_summary(tmp_path / "scene" / "events.h5")["events"]
    assert about["unit"] == "ns" and about["t_last_us"] == panning.events.t_us[-1]


def test_no_events(tmp_path, some_events):
    write_flat(tmp_path / "events.h5", some_events(3)[:0])
    about = path_summary(tmp_path / "events.h5")["events"]
    assert about["count"] == 0 and about["t_first_us"] is None


def test_unsound_events_are_reported(tmp_path, some_events):
    events = some_events(2_000)
    turned = replace(events, t_us=events.t_us[::-1])
    write_flat(tmp_path / "events.h5", turned)
    with pytest.raises(CaptureError, match="not ascending"):
        path_summary(tmp_path / "events.h5")


def test_a_missing_capture(tmp_path):
    with pytest.raises(CaptureError, match="capture not found"):
        path_summary(tmp_path / "garden")
