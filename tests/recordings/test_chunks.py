from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.recordings.chunks import CHUNK, RawChunk, merge_chunks, resolve_size
from sharpfield.recordings.recording import ReadLog, Recording

SIZE = (12, 10)


def piece(t_us: list[int] | np.ndarray, x: object = 0) -> RawChunk:
    count = len(t_us)
    return RawChunk(
        np.broadcast_to(np.asarray(x, np.uint16), count),
        np.zeros(count, np.uint16),
        np.asarray(t_us, np.int64),
        np.ones(count, np.int8),
    )


@pytest.mark.parametrize("length", [1, 7, 1000, CHUNK - 1, CHUNK, 3 * CHUNK + 5])
def test_chunks_are_the_same_for_pieces_of_any_length(length: int) -> None:
    count = min(2 * CHUNK + 1000, 2000 * length + 1)
    t_us = np.arange(count)
    pieces = (piece(t_us[i : i + length]) for i in range(0, count, length))
    log = ReadLog()
    chunks = list(merge_chunks(pieces, SIZE, where="a", log=log))
    np.testing.assert_array_equal(np.concatenate([chunk.t_us for chunk in chunks]), t_us)
    assert all(CHUNK // 2 <= len(chunk) <= CHUNK for chunk in chunks[:-1])
    assert 0 < len(chunks[-1]) <= CHUNK
    assert not str(log)


def test_no_pieces_are_no_chunks() -> None:
    assert not list(merge_chunks(iter([piece([])]), SIZE, where="a", log=ReadLog()))
    empty = Recording(
        Path("a"), "test", SIZE, lambda: merge_chunks(iter([]), SIZE, where="", log=ReadLog())
    )
    assert len(empty.load()) == 0


def test_what_cannot_be_is_dropped_and_counted() -> None:
    log = ReadLog()
    pieces = [piece([1, 2, 3, 4], [0, 12, 11, 65535]), piece([2, 3, 9, 8, 9])]
    (chunk,) = merge_chunks(iter(pieces), SIZE, where="a", log=log)
    assert chunk.t_us.tolist() == [1, 3, 3, 9, 9]
    assert str(log) == ("2 events outside the sensor, 2 events earlier than those before them")


def test_few_late_events_are_dropped_but_no_more() -> None:
    t_us = np.arange(100_000)
    t_us[500:1000:5] -= 50
    log = ReadLog()
    (chunk,) = merge_chunks(iter([piece(t_us)]), SIZE, where="a", log=log)
    assert len(chunk) == 99_900 and (np.diff(chunk.t_us) >= 0).all()


def test_events_that_are_not_in_order_are_refused() -> None:
    pieces = [piece(np.arange(1000)), piece(np.arange(500, 1000))]
    with pytest.raises(CaptureError) as refused:
        list(merge_chunks(iter(pieces), SIZE, where="a.raw", log=ReadLog()))
    assert str(refused.value) == (
        "CaptureError: event times are not ascending\n"
        "  where  a.raw\n"
        "  got    event 1000 at 500 us after 999 us, 499 such events so far\n"
        "  do     sort the events by time (stable), and check that clock wraps were undone"
    )


def test_most_events_outside_the_sensor_are_an_error() -> None:
    x = np.where(np.arange(1000) < 600, 40, 3)
    with pytest.raises(CaptureError) as refused:
        list(merge_chunks(iter([piece(np.arange(1000), x)]), SIZE, where="a.raw", log=ReadLog()))
    assert str(refused.value) == (
        "CaptureError: most events lie outside the sensor\n"
        "  where  a.raw\n"
        "  got    600 of 1,000, x up to 40 and y up to 0, of 12 x 10 pixels\n"
        "  do     check the size of the sensor, and which column is which"
    )
    log = ReadLog()
    x = np.where(np.arange(1000) < 400, 40, 3)
    (chunk,) = merge_chunks(iter([piece(np.arange(1000), x)]), SIZE, where="a.raw", log=log)
    assert len(chunk) == 600 and str(log) == "400 events outside the sensor"


def test_sizes() -> None:
    assert resolve_size((3, 4), None, "a") == resolve_size(None, (3, 4), "a") == (3, 4)
    with pytest.raises(CaptureError, match="does not state its sensor resolution"):
        resolve_size(None, None, "a")
    with pytest.raises(CaptureError, match="no sensor has this size"):
        resolve_size((0, 4), None, "a")
    with pytest.raises(CaptureError, match="the size given is not the one in the file"):
        resolve_size((3, 4), (4, 3), "a")
