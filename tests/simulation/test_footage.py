import cv2
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.simulation.footage import Footage, folder_footage, simulate_footage, video_footage
from sharpfield.simulation.sensors.event_pixels import EventSensor


def ramp(count: int) -> np.ndarray:
    """Images that grow brighter, display values; left faster than right."""
    value = 60 + np.arange(count)[:, None] * np.array([9.0, 6, 3, 1])
    return np.broadcast_to(value[:, None, :, None], (count, 6, 4, 3)).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    for i, image in enumerate(ramp(12)):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), image)
    (tmp_path / "notes.txt").write_text("not a image")
    return tmp_path


def test_a_folder_becomes_frames_and_events(folder):
    footage = folder_footage(folder, per_second=500.0, encoding="gamma2.2")
    capture = simulate_footage(footage, group=3, event_sensor=EventSensor(threshold_on=0.1))
    frames, light = capture.needed_frames, (ramp(12) / 255) ** 2.2
    np.testing.assert_array_equal(frames.exposure.open_us, [0, 6000, 12000, 18000])
    np.testing.assert_array_equal(frames.exposure.close_us, [4000, 10000, 16000, 22000])
    for i in range(4):
        a, b, c = light[3 * i : 3 * i + 3]
        mean = 255 * (0.25 * a + 0.5 * b + 0.25 * c) ** (1 / 2.2)
        assert np.abs(frames.images[i] - mean).max() <= 0.51
        np.testing.assert_array_equal(frames.truth[i], ramp(12)[3 * i + 1])
    events = capture.needed_events
    change = np.log((light[-1] + 1e-5) / (light[0] + 1e-5))[0, :, 0]
    counts = np.bincount(events.x, minlength=4)
    np.testing.assert_array_equal(counts, 6 * np.floor(change / 0.1).astype(int))
    assert capture.known.unknown == ("poses", "intrinsics", "bounds") and set(events.p) == {1}


def test_given_times_are_kept(folder):
    times = np.cumsum(np.arange(1, 13)) * 1000
    capture = simulate_footage(folder_footage(folder, times_us=times), group=1, every=5)
    np.testing.assert_array_equal(capture.needed_frames.exposure.open_us, times[[0, 5, 10]])
    assert capture.needed_frames.exposure.instant.all()
    assert times[0] <= capture.needed_events.t_us[0] <= capture.needed_events.t_us[-1] <= times[-1]


def test_a_video_becomes_frames_and_events(tmp_path):
    file = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for k in range(10):
        writer.write(np.full((48, 64, 3), 40 + 15 * k, np.uint8))
    writer.release()
    footage = video_footage(file, per_second=250.0)
    np.testing.assert_array_equal(footage.times_us, np.arange(10) * 4000)
    capture = simulate_footage(footage, group=5)
    assert capture.camera.size == (64, 48) and len(capture.needed_frames) == 2
    assert len(capture.needed_events) > 64 * 48
    np.testing.assert_array_equal(video_footage(file).times_us, np.arange(10) * 40_000)


def test_bad_footage_says_so(folder, tmp_path):
    with pytest.raises(CaptureError, match="no images found"):
        folder_footage(tmp_path / "nowhere", per_second=10.0)
    with pytest.raises(OptionError, match="either the rate of the images or their times"):
        folder_footage(folder)
    with pytest.raises(CaptureError, match="one time for each image.*\n.*\n  got    12 images, 3"):
        folder_footage(folder, times_us=np.arange(3))
    with pytest.raises(CaptureError, match="not a video that can be decoded"):
        video_footage(folder / "notes.txt")
    with pytest.raises(
        OptionError, match="grouped like this\n.*\n  got    12 images in groups of 13"
    ):
        simulate_footage(folder_footage(folder, per_second=10.0), group=13)
    cv2.imwrite(str(folder / "999.png"), np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(CaptureError, match="different sizes\n  where  .*, image 12\n  got    5x5"):
        simulate_footage(folder_footage(folder, per_second=10.0), group=2)
    with pytest.raises(CaptureError, match="times of images must ascend"):
        Footage("x", np.array([0, 5, 5]), lambda: iter(()))
