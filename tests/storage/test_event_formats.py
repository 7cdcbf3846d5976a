import numpy as np
import pytest

from sharpfield.core.errors import OptionError
from sharpfield.recordings.prophesee.evt import open_evt
from sharpfield.storage.event_cache import read_events
from sharpfield.storage.event_layouts import open_events
from sharpfield.storage.event_writer import FORMATS, exporting_events


def read_back(path):
    if path.suffix == ".csv":
        t_us, x, y, p = np.loadtxt(path, np.int64, delimiter=",", skiprows=1, ndmin=2).T
        return x, y, t_us, p
    if path.suffix == ".raw":
        events = open_evt(path).load()
        return events.x, events.y, events.t_us, events.p
    own = {} if path.suffix == ".h5" else {"unit": "us", "size": (12, 10)}
    with open_events(path, **own) as file:
        events = read_events(file)
    return events.x, events.y, events.t_us, events.p


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("cuts", [[0, 1000], [0, 300, 300, 999, 1000]])
def test_pieces_make_the_whole(tmp_path, some_events, ending, cuts):
    events, path = some_events(1000), tmp_path / f"events{ending}"
    with exporting_events(path, events[:0]) as append:
        for first, last in zip(cuts, cuts[1:], strict=False):
            append(events[first:last])
        assert not path.exists()
    for found, expected in zip(
        read_back(path), (events.x, events.y, events.t_us, events.p), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("ending", FORMATS)
def test_a_file_appears_whole_or_not_at_all(tmp_path, some_events, ending):
    events = some_events(100)
    with pytest.raises(KeyboardInterrupt):
        with exporting_events(tmp_path / f"events{ending}", events[:0]) as append:
            append(events)
            raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_other_endings_are_refused(tmp_path, some_events):
    with pytest.raises(OptionError, match=r"name a file with .h5, .npz, .csv"):
        with exporting_events(tmp_path / "events.txt", some_events(1)):
            pass
