"""Reading Ev-DeblurNeRF's layout, laid out here by hand, row by row, as its authors describe it."""

import h5py
import numpy as np
import pytest
import torch

from sharpfield.captures.layout import ReadOptions
from sharpfield.captures.layouts import llff_events
from sharpfield.captures.read import read_capture
from sharpfield.core.capture import Known, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import write_image

WIDTH, HEIGHT = 12, 10
STAMPS = np.arange(1_000_000, 1_100_001, 5_000)


def pose_rows(times_us, *, focal=11.0):
    """LLFF rows of a camera that turns about the vertical and moves along x; +y is up."""
    rows = np.zeros((len(times_us), 17))
    for row, t in zip(rows, times_us, strict=True):
        angle, shift = (t - 1_000_000) / 4e5, (t - 1_000_000) / 1e6
        right = np.array([np.cos(angle), 0, -np.sin(angle)])
        down = np.array([0.0, -1, 0])
        backward = -np.cross(right, down)
        matrix = [down, right, backward, [shift, 2.0, 3.0], [HEIGHT, WIDTH, focal]]
        row[:15], row[15:] = np.stack(matrix, -1).ravel(), (1.5 + shift, 14.0)
    return rows


@pytest.fixture
def blender(tmp_path):
    """Nine frames, those number 0 and 8 sharp, and 400 events in ns; and what they should be."""
    folder = tmp_path / "scene"
    draw = np.random.default_rng(0)
    opens = 1_002_000 + np.arange(9) * 10_000
    closes = opens + 8_000
    opens[[0, 8]] = closes[[0, 8]] = [1_006_000, 1_086_000]
    images = draw.integers(0, 256, (9, HEIGHT, WIDTH, 3), dtype=np.uint8)
    for i, image in enumerate(images):
        write_image(folder / "images_1" / f"{i:02d}.png", image)
    middle = (opens + closes) // 2
    np.savez(
        folder / "images_1" / "timestamps.npz",
        timestamps=middle,
        timestamps_start=opens,
        timestamps_end=closes,
    )
    np.save(folder / "poses_bounds.npy", pose_rows(middle))
    np.save(folder / "all_poses_bounds.npy", pose_rows(STAMPS))
    np.save(folder / "all_timestamps.npy", STAMPS)
    columns = {
        "x": draw.integers(0, WIDTH, 400).astype(np.uint16),
        "y": draw.integers(0, HEIGHT, 400).astype(np.uint16),
        "t": np.sort(draw.integers(1_000_000_000, 1_100_000_000, 400)),
        "p": draw.integers(0, 2, 400).astype(np.uint8),
    }
    write_columns(folder, columns)
    return folder, images, columns


@pytest.fixture
def davis(blender):
    """The same with float us, float coordinates and their map, and stills from before."""
    folder, images, columns = blender
    x, y = rectified_map()
    np.savez(folder / "ev_map.npz", inv_mapx=x, inv_mapy=y)
    row, column = columns["y"].astype(int), columns["x"].astype(int)
    columns = {
        "x": x[row, column],
        "y": y[row, column],
        "t": columns["t"] / 1e3,
        "p": columns["p"] * 2.0 - 1,
    }
    write_columns(folder, columns)
    times = dict(np.load(folder / "images_1" / "timestamps.npz"))
    for name in times:
        times[name][4:] = 5_000 + 1_000 * np.arange(5)  # the last five: sharp, long before
    np.savez(folder / "images_1" / "timestamps.npz", **times)
    return folder, (row, column), columns


def rectified_map():
    row, column = np.indices((HEIGHT, WIDTH)).astype(np.float32)
    return column * np.float32(1.01) - np.float32(0.3), row + column * np.float32(0.01)


def write_columns(folder, columns):
    with h5py.File(folder / "events.h5", "w") as file:
        for name, column in columns.items():
            file[name] = column


def change(path, edit):
    """Load an npy file or an array of an npz, edit it in place, and write it again."""
    if path.suffix == ".npz":
        arrays = dict(np.load(path))
        edit(arrays)
        np.savez(path, **arrays)
        return
    array = np.load(path)
    edited = edit(array)
    np.save(path, array if edited is None else edited)


# The Blender variant


def test_frames_events_and_poses(blender):
    folder, images, columns = blender
    capture = read_capture(folder)
    assert capture.source == "ev-deblur-nerf" and capture.name == "scene"
    np.testing.assert_array_equal(capture.frames.images, images)
    assert capture.frames.names == tuple(f"{i:02d}" for i in range(9))
    assert capture.frames.encoding == "gamma2.2"
    np.testing.assert_array_equal(capture.split.test, [0, 8])
    np.testing.assert_array_equal(capture.frames.track, 0)
    np.testing.assert_array_equal(capture.events.x, columns["x"])
    np.testing.assert_array_equal(capture.events.p, np.where(columns["p"], 1, -1))
    np.testing.assert_array_equal(capture.events.t_us, np.floor(columns["t"] / 1e3 + 0.5))
    camera = capture.camera
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (11, 11, 6, 5)
    assert capture.near == 1.5 + 0.0 + (1_006_000 - 1_000_000) / 1e6 and capture.far == 14.0
    assert capture.clock.origin_us == 1_000_000 and capture.clock.span_us == 100_000


def test_axes_become_opencvs(blender):
    folder, _, _ = blender
    pose = read_capture(folder).trajectory.poses[10]
    angle = 50_000 / 4e5
    np.testing.assert_allclose(pose[:, 0], [np.cos(angle), 0, -np.sin(angle)], atol=1e-12)
    np.testing.assert_allclose(pose[:, 1], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(pose[:, 2], np.cross(pose[:, 0], pose[:, 1]), atol=1e-12)
    np.testing.assert_allclose(pose[:, 3], [0.05, 2, 3], atol=1e-12)


def test_the_trajectory_gives_the_poses_of_frames(blender):
    folder, _, _ = blender
    capture = read_capture(folder)
    down, right, backward, centre, _ = np.moveaxis(
        np.load(folder / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5), -1, 0
    )
    expected = np.stack([right, down, -backward, centre], -1)
    np.testing.assert_allclose(capture.frame_pose(np.arange(9)), expected, atol=1e-5)


def test_what_the_notes_say(blender):
    folder, _, _ = blender
    assert read_capture(folder).notes == {"event_times": "rounded from ns to us"}
    assert read_capture(folder).known == Known(thresholds=Thresholds(0.2, 0.2))


def test_events_without_a_pose_are_dropped_and_counted(blender):
    folder, _, columns = blender
    columns["t"][:10] = 999_999_000 - np.arange(10)[::-1]
    columns["t"][-2:] = [1_100_000_400, 1_100_000_600]  # rounds to the last stamp; and beyond
    write_columns(folder, columns)
    capture = read_capture(folder)
    assert capture.notes["events_outside_trajectory"] == 11
    assert len(capture.events) == 389 and capture.events.t_us[-1] == 1_100_000


def test_truth_is_matched_by_name(blender):
    folder, images, _ = blender
    np.savez(folder / "truth.npz", **{"03": images[3] // 2, "07": images[7] // 3})
    frames = read_capture(folder).frames
    np.testing.assert_array_equal(np.flatnonzero(frames.truth_known), [3, 7])
    np.testing.assert_array_equal(frames.truth[3], images[3] // 2)
    np.testing.assert_array_equal(frames.truth[7], images[7] // 3)


def test_smaller_images_have_a_shorter_focal_length(blender):
    folder, _, _ = blender
    (folder / "images_1").rename(folder / "images_4")
    assert read_capture(folder).camera.fx_px == 11.0 / 4


def test_options_overrule_the_layout(blender):
    folder, _, _ = blender
    capture = read_capture(folder, ReadOptions(encoding="srgb", hold_out="last:2", threshold=0.3))
    assert capture.frames.encoding == "srgb"
    np.testing.assert_array_equal(capture.split.test, [7, 8])
    assert capture.known.thresholds == Thresholds(0.3, 0.3)


@pytest.mark.parametrize(("unit", "factor"), [("ns", 1), ("us", 1e-3), ("ms", 1e-6), ("s", 1e-9)])
def test_other_units_can_be_told(blender, unit, factor):
    folder, _, columns = blender
    expected = read_capture(folder).events.t_us
    write_columns(folder, columns | {"t": columns["t"] * factor})
    np.testing.assert_array_equal(
        read_capture(folder, ReadOptions(event_unit=unit)).events.t_us, expected
    )


def test_a_file_that_states_its_unit_is_believed(blender):
    folder, _, columns = blender
    write_columns(folder, columns | {"t": columns["t"] // 1000})
    with h5py.File(folder / "events.h5", "a") as file:
        file.attrs["tick_ns"] = 1000
    capture = read_capture(folder)
    assert capture.events.t_us[0] == columns["t"][0] // 1000
    assert "event_times" not in capture.notes


# The Color-DAVIS variant


def test_rectified_events_know_their_colour(davis):
    folder, (row, column), columns = davis
    capture = read_capture(folder)
    assert capture.events.rectified and capture.events.coloured
    np.testing.assert_array_equal(capture.events.x, columns["x"])
    np.testing.assert_array_equal(capture.events.p, columns["p"])
    np.testing.assert_array_equal(capture.events.t_us, np.floor(columns["t"] + 0.5))
    sites = capture.events.site_colour
    colour = {
        (x, y): channel for x, y, channel in zip(sites.x, sites.y, sites.channel, strict=True)
    }
    found = [colour[place] for place in zip(columns["x"], columns["y"], strict=True)]
    rggb = np.where(row % 2 == column % 2, np.where(row % 2, 2, 0), 1)
    np.testing.assert_array_equal(found, rggb)


def test_what_differs_from_blender(davis):
    folder, _, _ = davis
    capture = read_capture(folder)
    assert capture.frames.encoding == "linear"
    np.testing.assert_array_equal(capture.split.test, range(4, 9))
    assert capture.known.reference_poses == "trajectory"
    assert capture.known.thresholds.positive == 0.25
    assert capture.near == 1.5  # the nearest of the trajectory, not of the frames
    assert "event_times" not in capture.notes


def test_stills_from_before_have_tracks_of_their_own(davis):
    folder, _, _ = davis
    capture = read_capture(folder)
    np.testing.assert_array_equal(capture.frames.track, [0, 0, 0, 0, 1, 2, 3, 4, 5])
    np.testing.assert_allclose(
        capture.frame_pose(np.arange(4, 9))[:, :, 3],
        np.load(folder / "poses_bounds.npy")[4:, 3:15:5],
        atol=1e-6,
    )
    assert capture.notes["frames_off_trajectory"] == "04, 05, 06, 07, 08"
    assert capture.clock.origin_us == 1_000_000  # times of the trajectory stay fine-grained


def test_a_frame_that_contradicts_the_trajectory_has_its_own_track(blender):
    folder, _, _ = blender

    def move(rows):
        rows[5, 3] += 1.5 / 11 * 1.51  # 1.5 px at the nearest depth
        rows[6, 3] += 0.5 / 11 * 1.51

    change(folder / "poses_bounds.npy", move)
    capture = read_capture(folder)
    np.testing.assert_array_equal(capture.frames.track, [0, 0, 0, 0, 0, 1, 0, 0, 0])
    expected = np.load(folder / "poses_bounds.npy")[5, 3]
    assert capture.frame_pose(np.array([5]))[0, 0, 3] == pytest.approx(expected, abs=1e-6)
    moving = capture.trajectory.pose(torch.tensor([0.5]), torch.tensor([0]))
    assert moving[0, 0, 3] == pytest.approx(0.05, abs=1e-6)


def test_float32_poses_are_orthonormal_enough(blender):
    folder, _, _ = blender
    for name in ("poses_bounds.npy", "all_poses_bounds.npy"):
        change(folder / name, lambda rows: rows.astype(np.float32))
    assert (read_capture(folder).frames.track == 0).all()


# What can be wrong


def fails(folder, *parts):
    with pytest.raises(CaptureError) as caught:
        read_capture(folder)
    message = str(caught.value)
    for part in parts:
        assert part in message
    return message


@pytest.mark.parametrize(
    ("missing", "what"),
    [
        ("images_1/timestamps.npz", "file not found"),
        ("poses_bounds.npy", "file not found"),
        ("all_poses_bounds.npy", "poses over time are missing"),
        ("all_timestamps.npy", "poses over time are missing"),
        ("events.h5", "event file not found"),
    ],
)
def test_missing_files(blender, missing, what):
    folder, _, _ = blender
    (folder / missing).unlink()
    fails(folder, what, missing)


def test_poses_of_frames_alone_do_not_do(blender):
    folder, _, _ = blender
    (folder / "all_poses_bounds.npy").unlink()
    message = fails(folder, "poses over time")
    assert "give a pose at least every few ms" in message


def test_missing_images(blender):
    folder, _, _ = blender
    (folder / "images_1" / "03.png").unlink()
    fails(folder, "as many images as poses as exposures", "8 images, 9 poses, 9 exposures")


def test_images_of_different_sizes(blender):
    folder, _, _ = blender
    write_image(folder / "images_1" / "03.png", np.zeros((4, 4, 3), np.uint8))
    fails(folder, "images differ in size", "03.png", "12x10 RGB 8 bit and 4x4 RGB 8 bit")


def test_an_unreadable_image(blender):
    folder, _, _ = blender
    (folder / "images_1" / "03.png").write_bytes(b"not a image")
    fails(folder, "cannot decode image", "03.png")


def test_more_stamps_than_poses(blender):
    folder, _, _ = blender
    change(folder / "all_timestamps.npy", lambda times: times[:-1])
    fails(folder, "as many poses as times", "21 poses, 20 times")


def test_a_rotation_that_is_none(blender):
    folder, _, _ = blender
    change(folder / "all_poses_bounds.npy", lambda rows: rows.__setitem__((3, 0), 0.5))
    fails(folder, "all_poses_bounds.npy, pose 3", "not orthonormal", "axis convention")


def test_a_mirrored_rotation(blender):
    folder, _, _ = blender
    change(
        folder / "poses_bounds.npy",
        lambda rows: rows.__setitem__(np.s_[:, 0:15:5], -rows[:, ::5][:, :3]),
    )
    fails(folder, "poses_bounds.npy, pose 0", "right-handed", "det R = -1")


def test_a_pose_of_nan(blender):
    folder, _, _ = blender
    change(folder / "poses_bounds.npy", lambda rows: rows.__setitem__((4, 3), np.nan))
    fails(folder, "NaN or infinity", "poses_bounds.npy, pose 4")


def test_poses_that_do_not_cover_the_exposures(blender):
    folder, _, _ = blender
    for name in ("all_poses_bounds.npy", "all_timestamps.npy"):
        change(folder / name, lambda rows: rows[:15])
    fails(
        folder,
        "poses do not cover 1 of 8 exposures",
        "frame 07",
        "poses from 1000000 to 1070000 us, exposure from 1072000 to 1080000 us",
    )


def test_exposures_in_ns(blender):
    folder, _, _ = blender
    change(
        folder / "images_1" / "timestamps.npz",
        lambda arrays: arrays.update({name: t * 1000 for name, t in arrays.items()}),
    )
    fails(folder, "poses do not cover", "exposure times look like ns", "divide them by 1000")


def test_an_exposure_that_ends_before_it_begins(blender):
    folder, _, _ = blender
    change(
        folder / "images_1" / "timestamps.npz",
        lambda a: a.update(
            timestamps_start=a["timestamps_end"], timestamps_end=a["timestamps_start"]
        ),
    )
    fails(folder, "an exposure ends before it begins", "frame 1")


def test_exposure_times_without_a_name(blender):
    folder, _, _ = blender
    change(folder / "images_1" / "timestamps.npz", lambda arrays: arrays.pop("timestamps_end"))
    fails(folder, "array timestamps_end is missing", "timestamps, timestamps_start")


def test_events_in_us(blender):
    folder, _, columns = blender
    write_columns(folder, columns | {"t": columns["t"] // 1000})
    fails(folder, "events.h5", "look like us where ns were expected", "event_unit")


def test_unsorted_events(blender):
    folder, _, columns = blender
    columns["t"][[50, 300]] = columns["t"][[300, 50]]
    write_columns(folder, columns)
    fails(folder, "event times are not ascending", "events.h5", "sort the events by time")


def test_events_outside_the_sensor(blender):
    folder, _, columns = blender
    columns["x"][17] = WIDTH
    write_columns(folder, columns)
    fails(folder, "events lie outside the sensor", "sensor size 12", "counts pixels from 1")


def test_a_truncated_event_file(blender):
    folder, _, _ = blender
    data = (folder / "events.h5").read_bytes()
    (folder / "events.h5").write_bytes(data[: len(data) // 2])
    fails(folder, "truncated", "events.h5", "copy or convert it again")


def test_pickled_stamps(blender):
    folder, _, _ = blender
    np.save(folder / "all_timestamps.npy", np.array([{"run": "me"}], object))
    fails(folder, "pickled Python objects", "all_timestamps.npy")


def test_a_map_of_another_sensor(davis):
    folder, _, _ = davis
    np.savez(folder / "ev_map.npz", inv_mapx=np.zeros((4, 4)), inv_mapy=np.zeros((10, 12)))
    fails(
        folder,
        "array inv_mapx is missing, or differs from the sensor in size",
        "(4, 4)",
        "(10, 12)",
    )


def test_truth_of_another_size(blender):
    folder, images, _ = blender
    np.savez(folder / "truth.npz", **{"03": images[3][:4]})
    fails(folder, "sharp image differs from the frame", "truth.npz, 03")


# A capture rendered at 1000 images per second


def test_atelier(samples):
    folder = samples / "blender" / "atelier"
    if not folder.is_dir():
        pytest.skip("no blender/atelier among the sample recordings")
    capture = read_capture(folder)
    assert llff_events.recognise(folder)
    assert len(capture.events) == 1_820_374
    assert capture.frames.images.shape == (18, 200, 300, 3)
    np.testing.assert_array_equal(capture.split.test, [0, 8, 16])
    np.testing.assert_array_equal(np.flatnonzero(capture.frames.exposure.instant), [0, 8, 16])
    assert (capture.frames.exposure.duration_us[capture.split.train] == 64_000).all()
    np.testing.assert_array_equal(np.flatnonzero(capture.frames.truth_known), capture.split.train)
    assert (capture.near, capture.far) == (1.5, 14.0)
    assert (capture.frames.track == 0).all()
    assert set(np.unique(capture.events.p)) == {-1, 1}
