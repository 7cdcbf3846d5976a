"""The doctor finds each planted mistake, names it, and leaves a sound capture alone."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from sharpfield.captures.native import layout as native
from sharpfield.cli.doctor import doctor_command
from sharpfield.core.capture import Capture, Known, Split
from sharpfield.core.frames import Exposure
from sharpfield.geometry.trajectory import Stamped
from sharpfield.preparation.doctor.checkup import examine, examine_path
from sharpfield.preparation.doctor.events import check_light, odd_pixels
from sharpfield.preparation.doctor.findings import Checkup
from sharpfield.preparation.poses.path import frames_on_tracks
from sharpfield.simulation.sensors.event_pixels import SENSORS
from sharpfield.simulation.static_capture import Rig, Timing, simulate


@lru_cache
def sound() -> Capture:
    rig = Rig(size=(112, 80), event_sensor=SENSORS["dvs346"])
    timing = Timing(frames=8, exposure_us=40_000, interval_us=56_000, step_us=2000)
    return simulate("garden", "shaky", rig=rig, timing=timing, seed=5)


def nanoseconds(capture: Capture) -> Capture:
    events = capture.needed_events
    return replace(capture, events=replace(events, t_us=events.t_us * 1000))


def frames_late(capture: Capture) -> Capture:
    kept = np.arange(len(capture.needed_frames) - 1)
    frames = frames_on_tracks(capture.needed_frames, kept, capture.needed_frames.track[kept])
    late = Exposure(frames.exposure.open_us + 20_000, frames.exposure.close_us + 20_000)
    split = Split(*(part[part < len(kept)] for part in (capture.split.train, capture.split.test)))
    return replace(capture, frames=replace(frames, exposure=late), split=split)


def swapped(capture: Capture) -> Capture:
    events = capture.needed_events
    return replace(capture, events=replace(events, x=events.y, y=events.x))


def swapped_inside(capture: Capture) -> Capture:
    """Only those events whose exchanged coordinates still lie on the sensor."""
    events = capture.needed_events
    inside = np.flatnonzero((events.x < events.height) & (events.y < events.width))
    part = replace(
        events, x=events.y[inside], y=events.x[inside], t_us=events.t_us[inside], p=events.p[inside]
    )
    return replace(capture, events=part)


def flipped(capture: Capture) -> Capture:
    events = capture.needed_events
    return replace(capture, events=replace(events, p=(-events.p).astype(np.int8)))


def mirrored(capture: Capture) -> Capture:
    events = capture.needed_events
    x = (events.width - 1 - events.x).astype(events.x.dtype)
    return replace(capture, events=replace(events, x=x))


def wrong_focal(capture: Capture) -> Capture:
    camera = capture.camera
    return replace(
        capture, camera=replace(camera, fx_px=camera.fx_px * 1.3, fy_px=camera.fy_px * 1.3)
    )


def readout_limit(capture: Capture) -> Capture:
    """A sensor that reads out so many events in 100 us, and loses the rest."""
    events = capture.needed_events
    slot = events.t_us // 100
    begins = np.flatnonzero(np.diff(slot, prepend=-1) != 0)
    rank = np.arange(len(slot)) - np.repeat(begins, np.diff(begins, append=len(slot)))
    read = rank < np.percentile(np.bincount(slot - slot[0]), 40)
    part = replace(
        events, x=events.x[read], y=events.y[read], t_us=events.t_us[read], p=events.p[read]
    )
    return replace(capture, events=part)


def overexposed(capture: Capture) -> Capture:
    frames = capture.needed_frames
    bright = np.clip(frames.images.astype(int) * 3, 0, 255).astype(np.uint8)
    return replace(capture, frames=replace(frames, images=bright))


def hole_in_path(capture: Capture) -> Capture:
    path = capture.trajectory
    assert isinstance(path, Stamped)
    kept = np.abs(np.arange(len(path.times_us)) - len(path.times_us) / 2) > len(path.times_us) / 4
    return replace(
        capture, trajectory=Stamped(path.times_us[kept], path.poses[kept], capture.clock)
    )


PLANTED: dict[str, tuple[Callable[[Capture], Capture], str, str]] = {
    "ns read as us": (nanoseconds, "time-unit", "event times look like ns"),
    "frames shifted 20 ms": (frames_late, "time-shift", "ms too late"),
    "x and y swapped": (swapped, "axes-swapped", "x and y"),
    "x and y swapped inside": (swapped_inside, "axes-swapped", "x and y swapped"),
    "polarity flipped": (flipped, "polarity-flipped", "polarity flipped"),
    "mirrored": (mirrored, "mirrored", "x mirrored"),
    "wrong focal length": (wrong_focal, "focal-length", "focal length"),
    "saturated sensor": (readout_limit, "events-saturated", "saturated"),
    "overexposed": (overexposed, "frames-saturated", "overexposed"),
    "half the trajectory missing": (hole_in_path, "poses-missing", "gap"),
}


def test_objects_on_white_are_not_overexposed() -> None:
    """As NeRF-synthetic's, whose background is white."""
    white = overexposed(sound())
    rendered = replace(white, known=Known(background="white"))
    for capture, told in ((white, True), (rendered, False)):
        checkup = Checkup("object")
        check_light(capture, checkup)
        assert any(found.check == "frames-saturated" for found in checkup.findings) is told


def test_a_sound_capture_has_no_error_and_no_warning() -> None:
    found = examine(sound())
    assert [one for one in found.sorted if one.severity != "note"] == []
    assert {"agreement", "thresholds", "poses-fit", "blur", "motion"} <= {
        one.check for one in found.findings
    }


@pytest.mark.parametrize("fault", PLANTED)
def test_exactly_the_planted_mistake_is_found(fault: str) -> None:
    plant, check, words = PLANTED[fault]
    found = examine(plant(sound()))
    errors = [one for one in found.sorted if one.severity == "error"]
    assert [one.check for one in errors] == [check], errors
    assert words in errors[0].what
    assert errors[0].got and errors[0].do


def test_the_shift_of_the_frames_is_measured() -> None:
    found = next(one for one in examine(frames_late(sound())).findings if one.severity == "error")
    late = int(found.what.split(" are ")[1].split(" ms")[0])
    assert abs(late - 20) <= 3


def test_half_a_trajectory_in_a_folder_is_a_finding_not_a_failure(tmp_path: Path) -> None:
    native.write(sound(), tmp_path / "half")
    with np.load(tmp_path / "half" / "trajectory.npz") as file:
        arrays = {name: file[name][: len(file["times_us"]) // 2] for name in file.files}
    np.savez(tmp_path / "half" / "trajectory.npz", **arrays)
    found, capture = examine_path(tmp_path / "half")
    assert capture is None
    assert [(one.severity, one.check) for one in found.findings] == [("error", "poses-missing")]
    assert "poses do not cover" in found.findings[0].what


def test_a_capture_without_poses_is_looked_at_as_far_as_it_goes() -> None:
    bare = replace(sound(), known=replace(sound().known, poses="unknown"))
    found = examine(bare)
    assert not found.has("error")
    assert "poses-unknown" in {one.check for one in found.findings}
    assert "agreement" in {one.check for one in found.findings}


def test_frames_alone_and_events_alone_can_be_looked_at() -> None:
    assert not examine(sound().without(events=True)).has("error")
    assert not examine(sound().without(frames=True)).has("error")


def test_hot_and_dead_pixels_stand_out() -> None:
    count = np.random.default_rng(0).poisson(60, (40, 50))
    count[3, 7], count[20, 30] = 0, 4000
    dead, hot = odd_pixels(count)
    assert np.argwhere(dead).tolist() == [[3, 7]]
    assert np.argwhere(hot).tolist() == [[20, 30]]


def test_command_writes_a_page_and_fails_on_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    native.write(sound(), tmp_path / "fine")
    doctor_command(tmp_path / "fine", tmp_path / "out", json=True)
    said = json.loads(capsys.readouterr().out)
    assert said["counts"]["error"] == 0
    assert json.loads((tmp_path / "out" / "doctor.json").read_text()) == said
    page = (tmp_path / "out" / "doctor.html").read_text()
    assert "ready for training" in page and "http://" not in page.replace("http://www.w3", "")
    shutil.rmtree(tmp_path / "fine" / "frames")
    with pytest.raises(SystemExit) as stopped:
        doctor_command(tmp_path / "fine")
    assert stopped.value.code == 1
    assert "error" in capsys.readouterr().out
