import io
import zipfile

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.storage.event_columns import (
    ZippedColumn,
    coordinates,
    known_unit,
    polarity,
    whole_us,
)


@pytest.mark.parametrize(
    ("unit", "stored"),
    [
        ("ns", np.array([0, 499, 500, 1499, 1500, 2_000_000_123])),
        ("us", np.array([0, 0, 1, 1, 2, 2_000_000], np.uint32)),
        ("ms", np.array([0.0, 0.0, 0.001, 0.001, 0.0019, 2000.0001])),
        ("s", np.array([0, 0, 1e-6, 1.2e-6, 2e-6, 2.0])),
    ],
)
def test_every_unit_becomes_us(unit, stored):
    found = whole_us(stored, unit, "file")
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, [0, 0, 1, 1, 2, 2_000_000])


def test_seconds_since_1970_keep_their_us():
    assert whole_us(np.array([1_700_000_000.123457]), "s", "file")[0] == 1_700_000_000_123_457


def test_times_before_zero_are_rounded_like_those_after():
    np.testing.assert_array_equal(whole_us(np.array([-1600, -400, 400]), "ns", ""), [-2, 0, 0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_time_that_is_not_finite_is_refused(bad):
    with pytest.raises(CaptureError, match="not a finite number") as caught:
        whole_us(np.array([1.0, bad]), "us", "events.h5")
    assert "events.h5, entry 1" in str(caught.value)


@pytest.mark.parametrize(
    "stored",
    [
        np.array([0, 1, 1], np.uint8),
        np.array([-1, 1, 1], np.int16),
        np.array([False, True, True]),
        np.array([-1.0, 1.0, 1.0]),
    ],
)
def test_every_convention_of_polarity_becomes_signs(stored):
    found = polarity(stored, "file")
    assert found.dtype == np.int8
    np.testing.assert_array_equal(found, [-1, 1, 1])


def test_mixed_conventions_of_polarity_are_refused():
    with pytest.raises(CaptureError, match="three values") as caught:
        polarity(np.array([-1, 0, 1, 1]), "file")
    assert "1 times -1, 1 times 0, 2 times 1" in str(caught.value)


def test_another_polarity_is_refused():
    with pytest.raises(CaptureError, match="polarity must be 0 or 1") as caught:
        polarity(np.array([0, 1, 7]), "file")
    assert "event 2" in str(caught.value) and "check which column" in str(caught.value)


def test_coordinates_keep_16_bits_and_floats():
    for kind in (np.int16, np.uint16, np.float32, np.float64):
        assert coordinates(np.arange(3, dtype=kind), "x", "").dtype == kind
    assert coordinates(np.arange(3), "x", "").dtype == np.uint16
    assert coordinates(np.arange(3, dtype=np.float16), "x", "").dtype == np.float32


@pytest.mark.parametrize("bad", [-1, 70_000])
def test_coordinates_that_fit_no_sensor_are_refused_before_they_wrap(bad):
    with pytest.raises(CaptureError, match="outside the sensor") as caught:
        coordinates(np.array([3, bad]), "x", "file")
    assert str(bad) in str(caught.value)


def test_an_unknown_unit_is_refused():
    with pytest.raises(OptionError, match="use one of ns, us, ms, s"):
        known_unit("min")


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_zipped_column_reads_any_part(method):
    values = np.arange(10_000, dtype=np.int32) * 3
    whole = io.BytesIO()
    np.save(whole, values)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method) as archive:
        archive.writestr("t.npy", whole.getvalue())
    with zipfile.ZipFile(packed) as archive:
        column = ZippedColumn(archive, "t.npy")
        assert len(column) == len(values)
        for part in (slice(0, 10), slice(9_000, 10_000), slice(5, 5), slice(17, 4_000)):
            np.testing.assert_array_equal(column[part], values[part])


def test_a_pickled_column_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.array([{"run": "me"}], object))
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        with pytest.raises(CaptureError, match="pickled Python objects"):
            ZippedColumn(archive, "t.npy")


def test_a_matrix_is_no_column(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.zeros((3, 4)))
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        with pytest.raises(CaptureError, match="one-dimensional"):
            ZippedColumn(archive, "t.npy")
