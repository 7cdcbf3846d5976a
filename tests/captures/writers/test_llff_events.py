from dataclasses import replace

import h5py
import numpy as np
import pytest

from sharpfield.captures.read import read_capture
from sharpfield.captures.writers import llff_events as write_llff_events
from sharpfield.core.camera import Camera
from sharpfield.core.capture import Known, Split, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.core.events import EventStream, SiteColour
from sharpfield.geometry.trajectory import Stamped, Still, Tracks


def returned(capture, tmp_path):
    write_llff_events.write(capture, tmp_path / "scene")
    return read_capture(tmp_path / "scene")


def expect_same_frames(found, capture):
    np.testing.assert_array_equal(found.frames.images, capture.frames.images)
    for name in ("open_us", "close_us"):
        np.testing.assert_array_equal(
            getattr(found.frames.exposure, name), getattr(capture.frames.exposure, name)
        )
    np.testing.assert_array_equal(found.frames.track, capture.frames.track)
    np.testing.assert_array_equal(found.split.test, capture.split.test)
    np.testing.assert_array_equal(found.split.train, capture.split.train)
    assert found.frames.encoding == capture.frames.encoding
    assert found.camera == capture.camera
    assert (found.near, found.far) == (capture.near, capture.far)


def test_a_mono_capture_comes_back(panning, tmp_path):
    truth = 255 - panning.frames.images
    known = np.arange(9) % 2 == 1
    truth[~known] = 0
    capture = replace(panning, frames=replace(panning.frames, truth=truth, truth_known=known))
    found = returned(capture, tmp_path)
    expect_same_frames(found, capture)
    np.testing.assert_array_equal(found.frames.truth, truth)
    np.testing.assert_array_equal(found.frames.truth_known, known)
    assert found.clock == capture.clock
    np.testing.assert_array_equal(found.trajectory.times_us, capture.trajectory.times_us)
    np.testing.assert_array_equal(found.trajectory.poses, capture.trajectory.poses)
    for name in ("x", "y", "t_us", "p"):
        one, other = getattr(found.events, name), getattr(capture.events, name)
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype


def test_known_thresholds_come_back(panning, tmp_path):
    noted = replace(panning, known=Known(thresholds=Thresholds(0.17, 0.31)))
    assert returned(noted, tmp_path).known.thresholds == Thresholds(0.17, 0.31)
    assert returned(panning, tmp_path).known.thresholds == Thresholds(0.2, 0.2)  # the authors' own


def test_its_files_are_those_of_the_published_data(panning, tmp_path):
    write_llff_events.write(panning, tmp_path / "scene")
    folder = tmp_path / "scene"
    assert sorted(path.name for path in (folder / "images_1").iterdir()) == [
        *(f"{i:02d}.png" for i in range(9)),
        "timestamps.npz",
    ]
    times = np.load(folder / "images_1" / "timestamps.npz")
    assert set(times) == {"timestamps", "timestamps_start", "timestamps_end", "start", "end"}
    assert np.load(folder / "poses_bounds.npy").shape == (9, 17)
    assert np.load(folder / "all_poses_bounds.npy").shape == (21, 17)
    assert np.load(folder / "all_timestamps.npy").dtype == np.int64
    assert not (folder / "ev_map.npz").exists()
    with h5py.File(folder / "events.h5") as file:
        assert set(file) == set("xytp")
        np.testing.assert_array_equal(file["t"][:], panning.events.t_us * 1000)  # ns
        assert set(np.unique(file["p"][:])) == {0, 1}


def rectified(panning):
    """The same capture, linear, of a rectified RGGB sensor; the last five frames held out."""
    row, column = np.indices((10, 12)).astype(np.float32)
    x, y = column * np.float32(1.02) - np.float32(0.1), row + np.float32(0.01) * column
    channel = (np.indices((10, 12)) % 2).sum(0).astype(np.int8)
    at = panning.events.y.astype(int), panning.events.x.astype(int)
    events = EventStream(
        x[at],
        y[at],
        panning.events.t_us,
        panning.events.p,
        12,
        10,
        site_colour=SiteColour(x.ravel(), y.ravel(), channel.ravel()),
    )
    return replace(
        panning,
        events=events,
        frames=replace(panning.frames, encoding="linear"),
        split=Split(np.arange(4), np.arange(4, 9)),
    )


def test_a_colour_capture_comes_back(panning, tmp_path):
    capture = rectified(panning)
    found = returned(capture, tmp_path)
    expect_same_frames(found, capture)
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(getattr(found.events, name), getattr(capture.events, name))
    for name in ("x", "y", "channel"):
        np.testing.assert_array_equal(
            getattr(found.events.site_colour, name), getattr(capture.events.site_colour, name)
        )
    assert found.known.reference_poses == "trajectory"


def test_stills_beside_the_trajectory_come_back(panning, tmp_path):
    capture = rectified(panning)
    draw = np.random.default_rng(4)
    still = np.tile(np.eye(3, 4), (5, 1, 1))
    still[:, :, 3] = draw.normal(size=(5, 3)) * 3
    capture = replace(
        capture,
        trajectory=Tracks([panning.trajectory], still),
        frames=replace(capture.frames, track=np.array([0, 0, 0, 0, 1, 2, 3, 4, 5])),
    )
    found = returned(capture, tmp_path)
    expect_same_frames(found, capture)
    np.testing.assert_array_equal(found.trajectory.still.poses, still)


def test_a_bayer_sensor_that_is_not_rectified_gets_the_identity_map(panning, tmp_path):
    capture = rectified(panning)
    plain = replace(panning.events, bayer="RGGB")
    found = returned(replace(capture, events=plain), tmp_path)
    np.testing.assert_array_equal(found.events.x, plain.x)
    colours = found.events.site_colour
    at = (colours.x == 3) & (colours.y == 1)
    assert colours.channel[at] == [2]  # row 1, column 3: odd, odd, blue


def test_an_unstamped_trajectory_is_sampled(panning, tmp_path):
    line = Stamped(panning.trajectory.times_us, panning.trajectory.poses, panning.clock, "linear")
    found = returned(replace(panning, trajectory=line), tmp_path)
    np.testing.assert_array_equal(found.trajectory.times_us, np.arange(0, 100_001, 5_000))
    np.testing.assert_allclose(found.trajectory.poses, panning.trajectory.poses, atol=1e-12)


def refusals(panning):
    colour = rectified(panning)
    deep = panning.frames.images.astype(np.uint16)
    return {
        "lens distortion": replace(
            panning, camera=Camera(12, 10, 11.0, 11.0, 6.0, 5.0, "brown", (0.1, 0.0, 0.0, 0.0, 0.0))
        ),
        "events of several cameras": replace(
            panning, events=replace(panning.events, track=np.zeros(5_000, np.uint16), tracks=2)
        ),
        "principal point": replace(panning, camera=Camera(12, 10, 11.0, 11.0, 6.5, 5.0)),
        "8-bit RGB": replace(panning, frames=replace(panning.frames, images=deep)),
        "images other than gamma2.2 beside mono events": replace(
            panning, frames=replace(panning.frames, encoding="linear")
        ),
        "images other than linear beside colour events": replace(
            colour, frames=replace(colour.frames, encoding="srgb")
        ),
        "held-out frames than every:8": replace(panning, split=Split(np.arange(8), np.array([8]))),
        "tile than RGGB": replace(colour, events=replace(panning.events, bayer="GRBG")),
        "positions other than": replace(
            colour,
            events=replace(
                colour.events,
                site_colour=SiteColour(*(np.zeros(3, np.float32),) * 2, np.zeros(3, np.int8)),
            ),
        ),
    }


@pytest.mark.parametrize(
    "what",
    [
        "lens distortion",
        "events of several cameras",
        "principal point",
        "8-bit RGB",
        "images other than gamma2.2 beside mono events",
        "images other than linear beside colour events",
        "held-out frames than every:8",
        "tile than RGGB",
        "positions other than",
    ],
)
def test_what_the_layout_has_no_place_for(panning, tmp_path, what):
    with pytest.raises(CaptureError, match="cannot store") as caught:
        write_llff_events.write(refusals(panning)[what], tmp_path / "scene")
    assert what in str(caught.value) and "write our own layout" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_still_camera_has_no_trajectory_to_write(panning, tmp_path):
    still = replace(panning, trajectory=Still(np.eye(3, 4)[None]))
    with pytest.raises(CaptureError, match="needs a moving camera"):
        write_llff_events.write(still, tmp_path / "scene")


def test_frames_and_events_are_both_needed(panning, tmp_path):
    with pytest.raises(CaptureError, match="needs events"):
        write_llff_events.write(panning.without(events=True), tmp_path / "scene")


def test_an_earlier_capture_is_replaced_and_nothing_else(panning, tmp_path):
    write_llff_events.write(panning, tmp_path / "scene")
    write_llff_events.write(panning, tmp_path / "scene")
    (tmp_path / "papers").mkdir()
    (tmp_path / "papers" / "poses_bounds.npy").write_text("mine")
    with pytest.raises(CaptureError, match="will not replace"):
        write_llff_events.write(panning, tmp_path / "papers")
