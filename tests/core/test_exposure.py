import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.core.frames import Exposure


def us(*times: int) -> np.ndarray:
    return np.array(times, np.int64)


def test_middle_and_duration():
    exposure = Exposure(us(0, 10, 7), us(4, 15, 7))
    assert len(exposure) == 3
    assert exposure.middle_us.tolist() == [2, 12, 7]
    assert exposure.duration_us.tolist() == [4, 5, 0]
    assert exposure.instant.tolist() == [False, False, True]
    assert exposure.window(1) == (10, 15)


def test_the_middle_of_late_times_does_not_overflow():
    late = 2**62
    assert Exposure(us(late), us(late + 10)).middle_us.tolist() == [late + 5]


def test_no_frames():
    assert len(Exposure(us(), us()).middle_us) == 0


def test_an_exposure_that_ends_before_it_begins():
    with pytest.raises(CaptureError) as refused:
        Exposure(us(0, 20), us(10, 15))
    assert str(refused.value) == (
        "CaptureError: an exposure ends before it begins\n"
        "  where  frame 1\n"
        "  got    opens at 20 us, closes at 15 us\n"
        "  do     check the order of the two columns of exposure times"
    )


def test_a_readout_lasts_from_the_first_row_to_the_last():
    rolling = Exposure(us(0), us(10), row_delay_us=12.5)
    assert rolling.readout_us(1) == 0 and rolling.readout_us(5) == 50
    assert Exposure(us(0), us(10)).readout_us(100) == 0


def test_rows_that_are_read_upwards():
    with pytest.raises(CaptureError) as refused:
        Exposure(us(0), us(10), row_delay_us=-1.0)
    assert str(refused.value) == (
        "CaptureError: rows of a rolling shutter must follow each other downwards\n"
        "  got    a row delay of -1 us\n"
        "  do     turn frames and events upside down"
    )
