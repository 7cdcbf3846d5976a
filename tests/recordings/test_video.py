import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.recordings.recording import ReaderOptions
from sharpfield.recordings.video import open_images, open_video
from sharpfield.storage.images import write_image
from tests.recordings import fuzz


def images(folder: Path, count: int = 4) -> Path:
    for i in range(count):
        write_image(folder / f"{i:04d}.png", np.full((6, 8, 3), 10 * i, np.uint8))
    return folder


def video(path: Path, times_ms: list[int]) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for i, t_ms in enumerate(times_ms):
            frame = av.VideoFrame.from_ndarray(
                np.full((48, 64, 3), 40 * (i % 6), np.uint8), "rgb24"
            )
            frame.pts, frame.time_base = t_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


# Videos


def test_frames_have_the_times_of_the_video(tmp_path):
    recording = open_video(video(tmp_path / "v.mkv", [0, 40, 90, 120]))
    frames = list(recording.frames())
    assert [frame.open_us for frame in frames] == [0, 40_000, 90_000, 120_000]
    assert frames[2].image.shape == (48, 64, 3)
    assert abs(int(frames[2].image.mean()) - 80) < 4
    assert recording.events is None


def test_slow_motion_has_the_rate_it_was_taken_at(tmp_path):
    recording = open_video(video(tmp_path / "v.mkv", [0, 40, 80]), ReaderOptions(fps=1000.0))
    assert [frame.close_us for frame in recording.frames()] == [0, 1000, 2000]


def test_a_torn_video_ends_early_or_is_refused(tmp_path):
    path = video(tmp_path / "v.mkv", [40 * i for i in range(30)])
    whole = path.read_bytes()
    for length in range(0, len(whole), max(len(whole) // 25, 1)):
        path.write_bytes(whole[:length])
        try:
            assert len(list(open_video(path).frames())) <= 30
        except CaptureError as error:
            assert str(path) in str(error)


def short_video() -> bytes:
    with tempfile.TemporaryDirectory() as name:
        return video(Path(name) / "v.mkv", [40 * i for i in range(12)]).read_bytes()


fuzz.register("video", fuzz.Case(short_video, open_video, ".mkv"))


def test_damaged_videos(tmp_path):
    outcomes = fuzz.campaign("video", files=60, folder=tmp_path)
    assert outcomes["refused"]


def test_the_sample_video(samples):
    frames = list(open_video(samples / "video" / "vid2e_seq1.mp4").frames())
    assert [frame.open_us for frame in frames] == [40_000 * i for i in range(9)]
    assert frames[0].image.shape == (260, 346, 3)


# Images


def opens(recording) -> list[tuple[int, int]]:
    return [(frame.open_us, frame.close_us) for frame in recording.frames()]


def test_images_listed_with_seconds(tmp_path):
    images(tmp_path / "images")
    (tmp_path / "images.txt").write_text(
        "".join(f"{0.04 * i:.9f} images/{i:04d}.png\n" for i in (0, 1, 3))
    )
    recording = open_images(tmp_path)
    assert opens(recording) == [(0, 0), (40_000, 40_000), (120_000, 120_000)]
    assert [frame.name for frame in recording.frames()] == ["0000", "0001", "0003"]


def test_exposures_of_two_columns(tmp_path):
    folder = images(tmp_path / "left")
    text = "# start_us, end_us\n" + "".join(f"{100 * i}, {100 * i + 30}\n" for i in range(4))
    (tmp_path / "exposure_timestamps_left.txt").write_text(text)
    assert opens(open_images(folder)) == [(100 * i, 100 * i + 30) for i in range(4)]


def test_starts_and_ends_in_two_files(tmp_path):
    folder = images(tmp_path / "Blur", 2)
    (tmp_path / "Exposure_start.txt").write_text("1615008142416409\n1615008142538749\n")
    (tmp_path / "Exposure_end.txt").write_text("1615008142520408\n1615008142642749\n")
    with pytest.raises(CaptureError, match="in which unit") as caught:
        open_images(folder)
    assert "0.1223 s if us" in str(caught.value)
    assert opens(open_images(folder, ReaderOptions(frame_unit="us")))[0] == (
        1615008142416409,
        1615008142520408,
    )


def test_timestamps_in_arrays(tmp_path):
    folder = images(tmp_path / "images_1")
    start = np.arange(4) * 1000
    np.savez(folder / "timestamps.npz", timestamps_start=start, timestamps_end=start + 500)
    assert opens(open_images(folder, ReaderOptions(frame_unit="ns"))) == [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 4),
    ]


def test_a_rate(tmp_path):
    assert opens(open_images(images(tmp_path / "p"), ReaderOptions(fps=30.0)))[3][0] == 100_000
    with pytest.raises(OptionError, match="between 0 and a million"):
        open_images(tmp_path / "p", ReaderOptions(fps=0.0))


def test_what_is_missing_is_asked_for(tmp_path):
    folder = images(tmp_path / "p")
    with pytest.raises(CaptureError, match="nothing says when the images were taken"):
        open_images(folder)
    for name in ("timestamps_a.txt", "timestamps_b.txt"):
        (folder / name).write_text("1\n2\n3\n4\n")
    with pytest.raises(CaptureError, match="several files may say when") as caught:
        open_images(folder)
    assert "timestamps_a.txt, timestamps_b.txt" in str(caught.value)
    chosen = open_images(folder, ReaderOptions(times=folder / "timestamps_a.txt", frame_unit="s"))
    assert opens(chosen)[1] == (2_000_000, 2_000_000)


def test_what_does_not_fit_is_refused(tmp_path):
    folder = images(tmp_path / "p")
    (folder / "timestamps.txt").write_text("1\n2\n3\n")
    with pytest.raises(CaptureError, match="one time for each image"):
        open_images(folder, ReaderOptions(frame_unit="us"))
    (folder / "timestamps.txt").write_text("1\n2\nsoon\n4\n")
    with pytest.raises(CaptureError, match="cannot read a time"):
        open_images(folder, ReaderOptions(frame_unit="us"))
    (tmp_path / "images.txt").write_text("0.1 ../../secret.png\n")
    with pytest.raises(CaptureError, match="lies outside the recording"):
        open_images(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match="no images found"):
        open_images(tmp_path / "empty", ReaderOptions(fps=1.0))
