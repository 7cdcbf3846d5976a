import av
import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.report.video import video_writer, write_video
from sharpfield.storage.images import list_images, read_images


def images(count=6, size=(50, 80), channels=3):
    y, x = np.mgrid[: size[0], : size[1]]
    for i in range(count):
        planes = [2 * x + 10 * i, 0 * x + 180, 4 * y][:channels]
        yield np.stack(planes, -1).clip(0, 255).astype(np.uint8)


def test_a_video_plays_in_browsers_and_shows_the_images(tmp_path):
    path = tmp_path / "videos" / "a.mp4"
    assert write_video(path, images(), fps=24.0) == 6
    with av.open(path) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 24
        shown = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
    assert len(shown) == 6
    for seen, made in zip(shown, images(), strict=True):
        assert np.abs(seen.astype(int) - made).mean() < 4
    assert path.read_bytes().find(b"moov") < path.read_bytes().find(b"mdat")  # plays at once


def test_odd_sizes_and_grey_are_padded(tmp_path):
    write_video(tmp_path / "a.mp4", images(size=(51, 81), channels=1))
    with av.open(tmp_path / "a.mp4") as file:
        frame = next(file.decode(video=0)).to_ndarray(format="rgb24")
    assert frame.shape == (52, 82, 3)
    expected = next(images(size=(51, 81), channels=1))
    assert np.abs(frame[:51, :81].astype(int) - expected).mean() < 4


def test_a_folder_gets_the_exact_images(tmp_path):
    folder = tmp_path / "frames"
    for count in (6, 4):  # a second video takes the place of the first
        write_video(folder, images(count))
        stored = read_images(list_images(folder))
        np.testing.assert_array_equal(stored, np.stack(list(images(count))))
    assert [path.name for path in list_images(folder)][:2] == ["0000.png", "0001.png"]


@pytest.mark.parametrize("name", ["a.mp4", "frames"])
def test_a_video_that_breaks_off_leaves_nothing(tmp_path, name):
    with pytest.raises(KeyboardInterrupt), video_writer(tmp_path / name) as write:
        write(next(images()))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_other_files_are_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(OptionError, match="will not replace a folder"):
        write_video(tmp_path, images())
    assert (tmp_path / "thesis.tex").exists()


def test_options_that_make_no_video(tmp_path):
    with pytest.raises(OptionError, match="unknown kind of video"):
        write_video(tmp_path / "a.avi", images())
    with pytest.raises(OptionError, match="positive frame rate"):
        write_video(tmp_path / "a.mp4", images(), fps=0.0)
