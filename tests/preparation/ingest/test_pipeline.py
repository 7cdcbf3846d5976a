"""The whole way: what simulated cameras wrote becomes the same capture from every container."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from sharpfield.captures.native import layout as native
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Capture
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.geometry.trajectory import Stamped
from sharpfield.preparation.ingest.options import (
    Cleaning,
    Crop,
    IngestOptions,
    IngestSummary,
    Optics,
    Scene,
    Timing,
)
from sharpfield.preparation.ingest.pipeline import ingest
from sharpfield.preparation.ingest.stage import StagingFolder
from sharpfield.recordings.open import open_recording
from sharpfield.recordings.recording import Frame, ReaderOptions, Recording, Triggers
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, simulate
from sharpfield.simulation.static_capture import Timing as Exposures
from sharpfield.storage.event_writer import exporting_events
from sharpfield.storage.images import write_image
from tests.recordings.aedat.aedat4_writer import write_aedat4
from tests.recordings.ros.ros1_writer import write_ros1_bag

SIZE = (32, 24)
SAME = IngestOptions(timing=Timing(clock="same"), scene=Scene(encoding="gamma2.2"))


def hush(doing: str, done: int, total: int | None) -> None:
    """Nobody watches."""


@pytest.fixture(scope="module")
def truth() -> Capture:
    """What the cameras saw: 8 frames of 20 ms, and a few thousand events."""
    return simulate(
        "garden",
        "glide",
        rig=Rig(size=SIZE, event_sensor=EventSensor(threshold_on=0.1, threshold_off=0.1)),
        timing=Exposures(frames=8, exposure_us=20_000, interval_us=24_000, test_every=0),
    )


def write_images(truth: Capture, folder: Path) -> Path:
    frames = truth.needed_frames
    for i in range(len(frames)):
        write_image(folder / "images" / f"{i:06d}.png", frames.images[i])
    lines = [f"{a}, {b}" for a, b in map(frames.exposure.window, range(len(frames)))]
    text = "# exposure_start_us, exposure_end_us\n" + "\n".join(lines)
    (folder / "exposure_timestamps.txt").write_text(text)
    return folder / "images"


def write_dsec(path: Path, events: EventStream) -> None:
    with h5py.File(path, "w") as file:
        file["events/x"], file["events/y"] = events.x, events.y
        file["events/t"] = (events.t_us - events.t_us[0]).astype(np.uint32)
        file["events/p"] = (events.p > 0).astype(np.uint8)
        file["t_offset"] = np.int64(events.t_us[0])
        marks = np.arange(0, events.t_us[-1] - events.t_us[0] + 1, 1000)
        file["ms_to_idx"] = np.searchsorted(file["events/t"][:], marks).astype(np.uint64)


def write_mvsec(path: Path, events: EventStream) -> None:
    with h5py.File(path, "w") as file:
        rows = np.stack([events.x, events.y, events.t_us / 1e6, events.p], -1)
        file["davis/left/events"] = rows.astype(np.float64)


def write_vid2e(path: Path, events: EventStream) -> None:
    path.mkdir()
    for i, part in enumerate(np.array_split(np.arange(len(events)), 4)):
        t = events.t_us[part] * 1000
        np.savez(path / f"{i:010d}.npz", x=events.x[part], y=events.y[part], t=t, p=events.p[part])


def write_rpg(path: Path, events: EventStream) -> None:
    path.mkdir()
    with (path / "events.txt").open("w") as file:
        for t, x, y, p in zip(events.t_us, events.x, events.y, events.p, strict=True):
            file.write(f"{t / 1e6:.6f} {x} {y} {int(p > 0)}\n")


def write_dv(path: Path, events: EventStream) -> None:
    write_aedat4(path, of_arrays(events, [])[0], packing="none")


def write_bag(path: Path, events: EventStream) -> None:
    pytest.importorskip("rosbags")
    write_ros1_bag(path, of_arrays(events, [])[0])


def export(path: Path, events: EventStream) -> None:
    with exporting_events(path, events[:0]) as append:
        append(events)


CONTAINERS: dict[str, tuple[Callable[[Path, EventStream], None], ReaderOptions]] = {
    "events.h5": (export, ReaderOptions()),
    "events.npz": (export, ReaderOptions()),
    "events.csv": (export, ReaderOptions(size=SIZE)),
    "events.raw": (export, ReaderOptions()),
    "dsec.h5": (write_dsec, ReaderOptions(size=SIZE)),
    "mvsec.h5": (write_mvsec, ReaderOptions(size=SIZE)),
    "vid2e": (write_vid2e, ReaderOptions(size=SIZE)),
    "dv.aedat4": (write_dv, ReaderOptions()),
    "ros.bag": (write_bag, ReaderOptions()),
    "rpg": (write_rpg, ReaderOptions(size=SIZE)),
}


def ingested(
    truth: Capture, folder: Path, options: IngestOptions = SAME, container: str = "events.h5"
) -> tuple[IngestSummary, Path]:
    write, told = CONTAINERS[container]
    write(folder / container, truth.needed_events)
    recordings = (
        open_recording(folder / container, told),
        open_recording(write_images(truth, folder)),
    )
    return ingest(recordings, folder / "capture", options, hush), folder / "capture"


def of_arrays(
    events: EventStream, frames: list[Frame], triggers: Triggers | None = None
) -> tuple[Recording, Recording]:
    """Two recordings that exist in memory only."""
    path = Path(__file__)
    chunks = [events[i : i + 1000] for i in range(0, len(events), 1000)]
    return (
        Recording(
            path,
            "arrays",
            size=(events.width, events.height),
            events=lambda: iter(chunks),
            triggers=None if triggers is None else lambda: triggers,
        ),
        Recording(path, "arrays", frames=lambda: iter(frames)),
    )


# Every container gives the same capture


@pytest.mark.parametrize("container", CONTAINERS)
def test_the_same_capture_from_every_container(truth, tmp_path, container):
    made, folder = ingested(truth, tmp_path, container=container)
    found = native.read_unposed(folder)
    for name in ("x", "y", "t_us", "p"):
        wanted = getattr(truth.needed_events, name)
        got = getattr(found.needed_events, name)
        np.testing.assert_array_equal(got, wanted, name)
    assert found.needed_events.x.dtype == np.uint16
    frames = found.needed_frames
    np.testing.assert_array_equal(frames.images, truth.needed_frames.images)
    np.testing.assert_array_equal(frames.exposure.open_us, truth.needed_frames.exposure.open_us)
    np.testing.assert_array_equal(frames.exposure.close_us, truth.needed_frames.exposure.close_us)
    assert (made.events, made.frames, made.left_out) == (len(truth.needed_events), 8, {})
    assert set(made.unknown) == {"poses", "intrinsics", "bounds"}


@pytest.mark.parametrize("container", ["dv.aedat4", "ros.bag"])
def test_frames_and_events_of_one_file(truth, tmp_path, container):
    events, frames = of_arrays(truth.needed_events, in_memory(truth))
    both = replace(events, frames=frames.frames)
    if container == "ros.bag":
        pytest.importorskip("rosbags")
        write_ros1_bag(tmp_path / container, both)
    else:
        write_aedat4(tmp_path / container, both, packing="none")
    recording = open_recording(tmp_path / container)
    made = ingest((recording,), tmp_path / "capture", SAME, hush)
    found = native.read_unposed(tmp_path / "capture")
    assert made.left_out == {}
    np.testing.assert_array_equal(found.needed_events.t_us, truth.needed_events.t_us)
    np.testing.assert_array_equal(found.needed_frames.images, truth.needed_frames.images)
    exposure = truth.needed_frames.exposure
    np.testing.assert_array_equal(found.needed_frames.exposure.open_us, exposure.open_us)
    np.testing.assert_array_equal(found.needed_frames.exposure.close_us, exposure.close_us)


def test_what_was_ingested_waits_for_its_poses(truth, tmp_path):
    _, folder = ingested(truth, tmp_path)
    with pytest.raises(CaptureError, match="the poses of the camera are unknown"):
        read_capture(folder)


def test_with_poses_and_lens_it_can_be_trained_on(truth, tmp_path):
    path = truth.trajectory
    assert isinstance(path, Stamped)
    np.savez(tmp_path / "path.npz", times_us=path.times_us, poses=path.poses)
    camera = truth.camera
    (tmp_path / "calib.txt").write_text(
        f"{camera.fx_px} {camera.fy_px} {camera.cx_px - 0.5} {camera.cy_px - 0.5} 0 0 0 0 0"
    )
    scene = replace(SAME.scene, poses=tmp_path / "path.npz", near=truth.near, far=truth.far)
    optics = Optics(calibration=tmp_path / "calib.txt")
    made, folder = ingested(truth, tmp_path, replace(SAME, scene=scene, optics=optics))
    found = read_capture(folder)
    assert made.unknown == ()
    assert found.camera == camera
    middle = np.array([3])
    np.testing.assert_allclose(found.frame_pose(middle), truth.frame_pose(middle), atol=1e-5)


# Nothing is lost when it is interrupted


class Unplugged(Exception):
    """What ends a recording early, in these tests."""


@pytest.mark.parametrize("after", ["counting events", "writing frames", "writing events"])
def test_what_was_interrupted_goes_on(truth, tmp_path, after):
    def unplug(doing: str, done: int, total: int | None) -> None:
        if doing == after and done > 5:
            raise Unplugged

    events, frames = of_arrays(truth.needed_events, in_memory(truth))
    out = tmp_path / "capture"
    with pytest.raises(Unplugged):
        ingest((events, frames), out, SAME, unplug)
    assert not out.exists()
    said: list[str] = []
    ingest((events, frames), out, SAME, lambda doing, done, total: said.append(doing))
    if after == "writing events":
        assert "writing frames" not in said, "frames were written again"
    found = native.read_unposed(out)
    np.testing.assert_array_equal(found.needed_events.t_us, truth.needed_events.t_us)
    np.testing.assert_array_equal(found.needed_frames.images, truth.needed_frames.images)
    assert [entry.name for entry in tmp_path.iterdir()] == ["capture"]


def test_parts_that_are_written_are_not_written_again(truth, tmp_path):
    events = truth.needed_events
    span = int(events.t_us[0]), int(events.t_us[-1])
    whole = np.tile(np.arange(len(events)), 200_000 // len(events) + 1)[:200_000]
    many = replace(
        events,
        x=events.x[whole],
        y=events.y[whole],
        t_us=np.sort(events.t_us[whole]),
        p=events.p[whole],
    )
    stage = StagingFolder(tmp_path / "capture", {"plan": 1}, part=65_536)

    def truncated():
        yield many[:100_000]
        raise Unplugged

    with pytest.raises(Unplugged):
        stage.write(truncated(), many[:0], span)
    written = {path.name: path.stat().st_mtime_ns for path in stage.folder.glob("part-*")}
    assert list(written) == ["part-000.h5"]
    stage = StagingFolder(tmp_path / "capture", {"plan": 1}, part=65_536)
    assert stage.resumed
    stage.write(iter([many[:30], many[30:]]), many[:0], span)
    assert written["part-000.h5"] == (stage.folder / "part-000.h5").stat().st_mtime_ns
    assert len(list(stage.folder.glob("part-*"))) == 4
    stage.join()
    with h5py.File(stage.capture / "events.h5") as file:
        times = file["events/t"][:] + file["t_offset"][()]
    np.testing.assert_array_equal(times, many.t_us)


def test_another_plan_starts_anew(tmp_path):
    first = StagingFolder(tmp_path / "capture", {"files": 1})
    (first.folder / "frames.json").write_text("{}")
    again = StagingFolder(tmp_path / "capture", {"files": 2})
    assert not again.resumed
    assert not again.frames_record.exists()


def test_what_is_not_a_capture_is_not_replaced(truth, tmp_path):
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "thesis.tex").write_text("years of work")
    with pytest.raises(CaptureError, match="will not replace what is not a capture"):
        ingested(truth, tmp_path)


# Time


def in_memory(truth: Capture, shift_us: int = 0) -> list[Frame]:
    held = truth.needed_frames
    return [
        Frame(held.images[i], begin + shift_us, end + shift_us, f"{i:06d}")
        for i in range(len(held))
        for begin, end in [held.exposure.window(i)]
    ]


def test_a_part_of_the_time(truth, tmp_path):
    start = int(truth.needed_events.t_us[0])
    options = replace(SAME, crop=Crop(30.0, 110.0))
    made, folder = ingested(truth, tmp_path, options)
    found = native.read_unposed(folder)
    wanted = truth.needed_events.window(start + 30_000, start + 110_001)
    np.testing.assert_array_equal(found.needed_events.t_us, wanted.t_us)
    assert found.clock.span_us == 80_000
    assert made.left_out["events outside the time range"] == len(truth.needed_events) - len(wanted)
    assert made.left_out["frames outside the time range"] == 8 - made.frames
    assert len(list((folder / "frames").iterdir())) == made.frames == len(found.needed_frames)
    with pytest.raises(OptionError, match="nothing was recorded in this time range"):
        ingested(truth, tmp_path, replace(SAME, crop=Crop(5e6, None)))


def test_triggers_say_when_frames_were_exposed(truth, tmp_path):
    exposure = truth.needed_frames.exposure
    edges = np.stack([exposure.open_us, exposure.close_us], -1).ravel()
    triggers = Triggers(edges, np.tile(np.array([1, -1], np.int8), 8), np.zeros(16, np.uint8))
    late = [replace(frame, close_us=frame.open_us) for frame in in_memory(truth, 123_456)]
    options = IngestOptions(scene=SAME.scene)
    out = tmp_path / "capture"
    made = ingest(of_arrays(truth.needed_events, late, triggers), out, options, hush)
    found = native.read_unposed(out).needed_frames.exposure
    np.testing.assert_array_equal(found.open_us, exposure.open_us)
    np.testing.assert_array_equal(found.close_us, exposure.close_us)
    assert "trigger" in made.clock
    with pytest.raises(CaptureError, match="one pulse on the trigger for each frame"):
        ingest(of_arrays(truth.needed_events, late[:5], triggers), tmp_path / "o", options, hush)


def test_an_offset_that_is_given_is_taken(truth, tmp_path):
    options = IngestOptions(timing=Timing(offset_ms=-50.0), scene=SAME.scene)
    frames = in_memory(truth, 50_000)
    ingest(of_arrays(truth.needed_events, frames), tmp_path / "capture", options, hush)
    found = native.read_unposed(tmp_path / "capture").needed_frames.exposure
    np.testing.assert_array_equal(found.open_us, truth.needed_frames.exposure.open_us)


def test_an_offset_that_nobody_can_tell_is_asked_for(truth, tmp_path):
    with pytest.raises(CaptureError) as caught:
        ingest(
            of_arrays(truth.needed_events, in_memory(truth)), tmp_path / "c", IngestOptions(), hush
        )
    assert "--offset-ms" in str(caught.value) or "give the offset" in str(caught.value)


# Which recording gives what


def test_two_that_both_have_events_are_refused(truth, tmp_path):
    events, _ = of_arrays(truth.needed_events, [])
    with pytest.raises(OptionError, match="one must give the events and the other the frames"):
        ingest((events, events), tmp_path / "c", IngestOptions(), hush)


def test_frames_of_another_size_are_a_question(truth, tmp_path):
    frames = [replace(f, image=np.repeat(np.repeat(f.image, 2, 0), 2, 1)) for f in in_memory(truth)]
    recordings = of_arrays(truth.needed_events, frames)
    with pytest.raises(CaptureError, match="frames and events have different sizes") as caught:
        ingest(recordings, tmp_path / "c", SAME, hush)
    assert "--resize" in str(caught.value)
    ingest(recordings, tmp_path / "c", replace(SAME, optics=Optics(resize=True)), hush)
    found = native.read_unposed(tmp_path / "c")
    np.testing.assert_array_equal(found.needed_frames.images, truth.needed_frames.images)


def test_frames_alone_and_events_alone(truth, tmp_path):
    events, frames = of_arrays(truth.needed_events, in_memory(truth))
    assert ingest((frames,), tmp_path / "f", SAME, hush).events == 0
    assert native.read_unposed(tmp_path / "f").events is None
    assert ingest((events,), tmp_path / "e", SAME, hush).frames == 0
    assert native.read_unposed(tmp_path / "e").frames is None


def test_hot_pixels_are_silenced_and_told(truth, tmp_path):
    events = truth.needed_events
    often = np.arange(events.t_us[0], events.t_us[-1], 50)
    t_us = np.concatenate([events.t_us, often])
    order = np.argsort(t_us, kind="stable")
    hot = np.full(len(often), 1)
    noisy = replace(
        events,
        x=np.concatenate([events.x, 7 * hot]).astype(np.uint16)[order],
        y=np.concatenate([events.y, 5 * hot]).astype(np.uint16)[order],
        t_us=t_us[order],
        p=np.concatenate([events.p, hot]).astype(np.int8)[order],
    )
    recordings = of_arrays(noisy, in_memory(truth))
    made = ingest(recordings, tmp_path / "c", SAME, hush)
    found = native.read_unposed(tmp_path / "c")
    assert made.hot_pixels == 1
    np.testing.assert_array_equal(found.notes["hot_pixels"], [[7, 5]])
    at = (noisy.x == 7) & (noisy.y == 5)
    assert made.left_out == {"events of hot pixels": int(at.sum())}
    np.testing.assert_array_equal(found.needed_events.t_us, noisy.t_us[~at])
    kept = ingest(recordings, tmp_path / "c", replace(SAME, cleaning=Cleaning(hot=0.0)), hush)
    assert kept.events == len(noisy)
