import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.read import layout_of, read_capture
from sharpfield.captures.writers import evdnerf as write_evdnerf
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Capture, Clock, Known, Split, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, checked
from sharpfield.core.frames import Exposure, Frames
from sharpfield.events.image import window_image
from sharpfield.events.index import build_index
from sharpfield.geometry.trajectory import Stamped, Still

WIDTH, HEIGHT, VIEWS, TIMES = 8, 6, 3, 17
START_US, SECOND_US = 10_000, 1_000_000


def looking_in(count: int) -> np.ndarray:
    """Cameras at a distance of 4 that look at the origin."""
    angle = np.linspace(0, 2, count)
    zero, one = np.zeros(count), np.ones(count)
    columns = [
        [-np.sin(angle), np.cos(angle), zero],
        [zero, zero, -one],
        [-np.cos(angle), -np.sin(angle), zero],
        [4 * np.cos(angle), 4 * np.sin(angle), zero],
    ]
    return np.moveaxis(np.array(columns), [0, 1, 2], [2, 1, 0])


def stream(tracks: tuple[int, ...], count: int, seed: int) -> EventStream:
    """Events before, during and after the second that the frames span."""
    draw = np.random.default_rng(seed)
    events = EventStream(
        x=draw.integers(0, WIDTH, count).astype(np.uint16),
        y=draw.integers(0, HEIGHT, count).astype(np.uint16),
        t_us=np.sort(draw.integers(0, SECOND_US + 20_000, count)),
        p=draw.choice(np.array([-1, 1], np.int8), count),
        width=WIDTH,
        height=HEIGHT,
        track=draw.choice(np.array(tracks, np.uint16), count),
        tracks=max(tracks) + 1,
    )
    return checked(events, "test")


@pytest.fixture(scope="module")
def rig() -> Capture:
    """Two views to learn from and one held out, 17 frames each."""
    t_us = np.tile(START_US + np.arange(TIMES) * SECOND_US // (TIMES - 1), VIEWS)
    images = np.random.default_rng(0).integers(
        0, 256, (VIEWS * TIMES, HEIGHT, WIDTH, 3), dtype=np.uint8
    )
    return Capture(
        camera=Camera(WIDTH, HEIGHT, 11.0, 11.0, WIDTH / 2, HEIGHT / 2),
        trajectory=Still(looking_in(VIEWS)),
        clock=Clock(0, SECOND_US + 20_000),
        near=2.0,
        far=6.0,
        frames=Frames(
            images,
            Exposure(t_us, t_us),
            np.repeat(np.arange(VIEWS), TIMES),
            tuple(f"{i}" for i in range(VIEWS * TIMES)),
            encoding="srgb",
        ),
        events=stream((0, 1), 3_000, 1),
        test_events=stream((2,), 900, 2),
        split=Split(np.arange(2 * TIMES), np.array([2 * TIMES + 4])),
        known=Known(thresholds=Thresholds(0.2, 0.2)),
    )


@pytest.fixture
def folder(rig: Capture, tmp_path: Path) -> Path:
    write_evdnerf.write(rig, tmp_path / "rig")
    return tmp_path / "rig"


def pickled(folder: Path, name: str, content: object) -> Path:
    """Streams as published, in place of the plain ones."""
    (folder / "data_train.npz").unlink(missing_ok=True)
    path = folder / name
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(content))
    else:
        array = np.empty(len(content), object)
        array[:] = content
        np.save(path, array, allow_pickle=True)
    return path


def raw(capture: Capture) -> list[np.ndarray]:
    columns = []
    for track in (0, 1):
        one = capture.needed_events.of_track(track).window(START_US, START_US + SECOND_US)
        columns.append(np.stack([1000 * (one.t_us - START_US), one.x, one.y, one.p], -1))
    return columns


def sums(events: EventStream, track: int, origin_us: int) -> np.ndarray:
    edges = [origin_us + i * SECOND_US // (TIMES - 1) for i in range(TIMES)]
    index = build_index(events)
    size = {"width": WIDTH, "height": HEIGHT, "track": track}
    counts = [window_image(index, a, b, **size) for a, b in zip(edges, edges[1:], strict=False)]
    return np.stack(counts)[..., 1] - np.stack(counts)[..., 0]


def test_what_is_written_is_read(rig: Capture, folder: Path) -> None:
    found = read_capture(folder)
    assert layout_of(folder) == found.source == "evdnerf"
    assert found.camera.size == (WIDTH, HEIGHT) and found.camera.fx_px == pytest.approx(11)
    np.testing.assert_allclose(found.trajectory.poses, rig.trajectory.poses, atol=1e-12)
    np.testing.assert_array_equal(found.frames.images, rig.frames.images)
    np.testing.assert_array_equal(found.frames.track, rig.frames.track)
    np.testing.assert_array_equal(
        found.frames.exposure.open_us, rig.frames.exposure.open_us - START_US
    )
    np.testing.assert_array_equal(found.split.train, rig.split.train)
    np.testing.assert_array_equal(found.split.test, 2 * TIMES + np.array([4, 12]))
    assert (found.near, found.far) == pytest.approx((2, 6))
    assert found.known.thresholds.positive == 0.2
    for name in ("events", "test_events"):
        window = getattr(rig, name).window(START_US, START_US + SECOND_US)
        for track in range(VIEWS):
            one, other = window.of_track(track), getattr(found, name).of_track(track)
            np.testing.assert_array_equal(other.t_us, one.t_us - START_US)
            for column in ("x", "y", "p", "track"):
                np.testing.assert_array_equal(getattr(other, column), getattr(one, column))


def test_sums_are_signed_thresholds_between_frames(rig: Capture, folder: Path) -> None:
    stored = np.load(folder / "data_frames_train.npy")
    assert stored.shape == (2, TIMES - 1, HEIGHT, WIDTH)
    for track in (0, 1):
        expected = 0.2 * sums(rig.needed_events, track, START_US)
        np.testing.assert_allclose(stored[track], expected, atol=1e-6)


@pytest.mark.parametrize("extra", [False, True], ids=["T-1", "T"])
def test_sums_alone_become_a_stream_with_the_same_sums(
    rig: Capture, folder: Path, extra: bool
) -> None:
    for name in ("train", "val"):
        (folder / f"data_{name}.npz").unlink()
        if extra:
            path = folder / f"data_frames_{name}.npy"
            np.save(path, np.pad(np.load(path), ((0, 0), (0, 1), (0, 0), (0, 0))))
    text = (folder / "transforms_train.json").read_text()
    (folder / "transforms_train.json").write_text(text.replace("threshold_", "was_"))
    found = read_capture(folder)
    assert found.known.thresholds.positive == pytest.approx(0.2, rel=1e-6)
    assert "spread evenly" in found.notes["event_times"]
    for track in (0, 1):
        expected = sums(rig.needed_events, track, START_US)
        np.testing.assert_array_equal(sums(found.needed_events, track, 0), expected)
    np.testing.assert_array_equal(sums(found.test_events, 2, 0), sums(rig.test_events, 2, START_US))


def test_a_threshold_that_does_not_fit_is_told(folder: Path) -> None:
    for path in folder.glob("data_*.npz"):
        path.unlink()
    with pytest.raises(CaptureError, match="not a whole number of thresholds") as caught:
        read_capture(folder, ReadOptions(threshold=0.3))
    assert "give the option `threshold`" in str(caught.value)
    np.testing.assert_array_equal(  # half the size, twice the events
        sums(read_capture(folder, ReadOptions(threshold=0.1)).needed_events, 0, 0),
        2 * sums(read_capture(folder).needed_events, 0, 0),
    )


@pytest.mark.parametrize("name", ["data_train.npy", "data_train.pkl"])
def test_pickled_streams_are_read_when_trusted(rig: Capture, folder: Path, name: str) -> None:
    expected = read_capture(folder).needed_events
    pickled(folder, name, raw(rig))
    found = read_capture(folder, ReadOptions(trust_pickle=True)).needed_events
    for column in ("x", "y", "t_us", "p", "track"):
        np.testing.assert_array_equal(getattr(found, column), getattr(expected, column))


def test_pickled_streams_are_left_alone_otherwise(rig: Capture, folder: Path) -> None:
    path = pickled(folder, "data_train.npy", raw(rig))
    assert read_capture(folder).notes["raw_streams"] == f"{path.name} is pickled and was not read"
    (folder / "data_frames_train.npy").unlink()
    with pytest.raises(CaptureError) as caught:
        read_capture(folder)
    assert str(caught.value) == (
        "CaptureError: the event streams are pickled: opening such a file may"
        " run code that it contains\n"
        f"  where  {path}\n"
        "  do     if you trust its source, give --trust-pickle"
        " (`trust_pickle=True`); or save it with np.savez, one array for each view"
    )


class Trap:
    """What a harmful file would hold."""

    def __reduce__(self) -> tuple:
        return (open, (str(self.mark), "w"))

    mark = Path()


@pytest.mark.parametrize("name", ["data_train.npy", "data_train.pkl"])
def test_even_trusted_files_run_nothing(rig: Capture, folder: Path, name: str) -> None:
    Trap.mark = folder / "harm"
    pickled(folder, name, [*raw(rig)[:1], Trap()])
    with pytest.raises(CaptureError, match="which builds no array"):
        read_capture(folder, ReadOptions(trust_pickle=True))
    assert not Trap.mark.exists()
    with (folder / name).open("rb") as file:  # the trap is real
        if name.endswith("npy"):
            np.load(file, allow_pickle=True)
        else:
            pickle.load(file)
    assert Trap.mark.exists()


def test_events_alone_are_enough(folder: Path) -> None:
    shutil.rmtree(folder / "train")
    shutil.rmtree(folder / "val")
    for path in folder.glob("data_*.npz"):
        path.unlink()
    found = read_capture(folder)
    assert found.frames is None and len(found.split.test) == 0 and found.camera.width == WIDTH


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda about: about["frames"].pop(0), "in the order of views"),
        (lambda about: about["frames"][3].update(time=0.9), "the same ascending times"),
        (lambda about: about["frames"][3].update(time=2), "between 0 and 1"),
        (lambda about: about["frames"][3].pop("time"), "`time` must be a number"),
        (
            lambda about: about["frames"][3].update(
                transform_matrix=about["frames"][20]["transform_matrix"]
            ),
            "the camera of a view must not move",
        ),
    ],
)
def test_malformed_transforms_are_told(folder: Path, change, message: str) -> None:
    path = folder / "transforms_train.json"
    about = json.loads(path.read_text())
    change(about)
    path.write_text(json.dumps(about))
    with pytest.raises(CaptureError, match=message):
        read_capture(folder)


def test_sums_of_another_shape_are_told(folder: Path) -> None:
    (folder / "data_train.npz").unlink()
    np.save(folder / "data_frames_train.npy", np.zeros((2, 5, HEIGHT, WIDTH)))
    with pytest.raises(CaptureError, match="do not match the views") as caught:
        read_capture(folder)
    assert "(2, 16 or 17, height, width)" in str(caught.value)


def test_what_the_layout_has_no_place_for_is_refused(rig: Capture, tmp_path: Path) -> None:
    frames, clock = rig.needed_frames, rig.clock
    longer = Exposure(frames.exposure.open_us, frames.exposure.open_us + 5)
    moving = Stamped(np.array([0, clock.span_us]), looking_in(2), clock)
    cases = {
        "exposures that last": replace(rig, frames=replace(frames, exposure=longer)),
        "cameras that move": replace(
            rig, trajectory=moving, frames=replace(frames, track=frames.track)
        ),
        "events of unknown thresholds": replace(rig, known=Known()),
        "a lens": replace(rig, camera=replace(rig.camera, cx_px=3.0)),
    }
    for what, capture in cases.items():
        with pytest.raises(CaptureError, match=f"cannot store {what}"):
            write_evdnerf.write(capture, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_longer_recording_is_made_to_last_a_second(rig: Capture, tmp_path: Path) -> None:
    events = rig.needed_events
    slow = replace(
        rig,
        clock=Clock(0, 2 * rig.clock.span_us),
        events=replace(events, t_us=2 * events.t_us),
        test_events=None,
        frames=replace(
            rig.frames,
            exposure=Exposure(2 * rig.frames.exposure.open_us, 2 * rig.frames.exposure.close_us),
        ),
    )
    write_evdnerf.write(slow, tmp_path / "slow")
    found = read_capture(tmp_path / "slow")
    assert found.test_events is None
    within = events.window(START_US, START_US + SECOND_US)
    np.testing.assert_array_equal(found.needed_events.t_us, within.t_us - START_US)
