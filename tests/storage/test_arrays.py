import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage.arrays import load_array, load_arrays, write_arrays


def test_arrays_come_back_whatever_their_name(tmp_path):
    arrays = {"file": np.arange(3), "allow": np.float32([1.5]), "scalar": np.array(2)}
    write_arrays(tmp_path / "a.npz", arrays)
    found = load_arrays(tmp_path / "a.npz")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def test_a_missing_file(tmp_path):
    with pytest.raises(CaptureError, match="file not found"):
        load_array(tmp_path / "a.npy")


def test_pickles_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"run": "me"}], object))
    np.savez(tmp_path / "a.npz", a=np.array([{"run": "me"}], object))
    for load, name in ((load_array, "a.npy"), (load_arrays, "a.npz")):
        with pytest.raises(CaptureError, match="may run code") as caught:
            load(tmp_path / name)
        assert name in str(caught.value) and "plain numbers" in str(caught.value)


@pytest.mark.parametrize(("load", "name"), [(load_array, "a.npy"), (load_arrays, "a.npz")])
def test_a_truncated_file(tmp_path, load, name):
    (np.save if name.endswith("npy") else np.savez)(tmp_path / name, np.arange(1_000))
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-100])
    with pytest.raises(CaptureError, match="cannot read arrays"):
        load(tmp_path / name)


def test_one_array_is_not_many(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(3))
    np.savez(tmp_path / "a.npz", a=np.arange(3))
    with pytest.raises(CaptureError, match="expected a single array"):
        load_array(tmp_path / "a.npz")
    with pytest.raises(CaptureError, match="expected an npz"):
        load_arrays(tmp_path / "a.npy")
