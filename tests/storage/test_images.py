import re
import struct
import zlib

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage.images import image_stack, list_images, read_image, read_images, write_image


def made_image(dtype=np.uint8, channels=3, size=(4, 6)):
    high = np.iinfo(dtype).max
    return (
        np.random.default_rng(1).integers(0, high, (*size, channels), endpoint=True).astype(dtype)
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_reading_gives_what_was_written(tmp_path, dtype, channels):
    image = made_image(dtype, channels)
    write_image(tmp_path / "a.png", image)
    read = read_image(tmp_path / "a.png")
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, image)


def test_red_comes_first(tmp_path):
    write_image(tmp_path / "red.jpg", np.full((8, 8, 3), [255, 0, 0], np.uint8))
    red = read_image(tmp_path / "red.jpg")[4, 4].astype(int)
    np.testing.assert_allclose(red, [255, 0, 0], atol=3)


def test_alpha_is_dropped_or_laid_on_white(tmp_path):
    image = made_image(channels=4)
    write_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image[..., :3])
    rgb, alpha = image[..., :3] / 255, image[..., 3:] / 255
    expected = 255 * (rgb * alpha + 1 - alpha)
    on_white = read_image(tmp_path / "a.png", alpha="white")
    np.testing.assert_allclose(on_white, expected, atol=0.5 + 1e-9)


def test_a_gamma_chunk_changes_nothing(tmp_path):
    path = tmp_path / "a.png"
    image = made_image()
    write_image(path, image)
    data = path.read_bytes()
    after_header = 8 + 25
    body = b"gAMA" + struct.pack(">I", 100000)  # linear
    chunk = struct.pack(">I", 4) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(data[:after_header] + chunk + data[after_header:])
    np.testing.assert_array_equal(read_image(path), image)


def test_many_come_in_order(tmp_path):
    images = [made_image(size=(3, 5)) + np.uint8(i) for i in range(40)]
    for i, image in enumerate(images):
        write_image(tmp_path / f"{i:02d}.png", image)
    (tmp_path / ".hidden.png").touch()
    (tmp_path / "notes.txt").touch()
    paths = list_images(tmp_path)
    assert [path.stem for path in paths] == [f"{i:02d}" for i in range(40)]
    np.testing.assert_array_equal(read_images(paths), np.stack(images))


def test_writing_leaves_no_other_file(tmp_path):
    write_image(tmp_path / "a.png", made_image())
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_truncated_file_is_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_image(path, made_image(size=(64, 64)))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(CaptureError, match="image file is truncated"):
        read_image(path)


def test_what_is_no_image_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"hello")
    with pytest.raises(CaptureError, match="cannot decode image"):
        read_image(tmp_path / "a.png")
    with pytest.raises(CaptureError, match="image not found"):
        read_image(tmp_path / "b.png")


def test_images_of_two_sizes_are_refused(tmp_path):
    write_image(tmp_path / "a.png", made_image(size=(4, 6)))
    write_image(tmp_path / "b.png", made_image(size=(4, 7)))
    message = "images differ in size or type.*b.png.*6x4 RGB 8 bit and 7x4 RGB 8 bit"
    with pytest.raises(CaptureError, match=re.compile(message, re.DOTALL)):
        read_images(list_images(tmp_path))


def test_large_stacks_are_cached_and_mapped(tmp_path):
    draw = np.random.default_rng(2)
    images = draw.integers(0, 256, (5, 10, 12, 3)).astype(np.uint8)
    paths = [tmp_path / "color" / f"{i}.png" for i in range(5)]
    for path, image in zip(paths, images, strict=True):
        write_image(path, image)
    calls = []

    def decode(path):
        calls.append(path)
        return read_image(path)

    first = image_stack(paths, decode, sources=paths, kind="colour", in_memory=100)
    assert isinstance(first, np.memmap) and not first.flags.writeable
    np.testing.assert_array_equal(first, images)
    again = image_stack(paths, decode, sources=paths, kind="colour", in_memory=100)
    np.testing.assert_array_equal(again, images)
    assert len(calls) == 6, "the second time only the first is decoded, for its size"
    write_image(paths[4], images[0])
    changed = image_stack(paths, decode, sources=paths, kind="colour", in_memory=100)
    np.testing.assert_array_equal(changed[4], images[0])
    loaded = image_stack(paths[:2], decode, sources=paths[:2], kind="colour")
    assert not isinstance(loaded, np.memmap)
    write_image(paths[1], images[1, :4])
    with pytest.raises(CaptureError, match="images differ in size or type"):
        image_stack(paths, decode, sources=paths, kind="colour")
