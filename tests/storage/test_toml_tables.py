import math
import tomllib

import numpy as np
import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage.toml_tables import read_toml, toml_text

TEXT = """
name = "garden"
count = 3
near = 1
yes = true
[camera]
distortion = [0.1, 2]
[[frame]]
name = "a"
"""


@pytest.fixture
def table(tmp_path):
    (tmp_path / "capture.toml").write_text(TEXT)
    return read_toml(tmp_path / "capture.toml")


def test_values_have_their_kind(table):
    assert table.text("name") == "garden"
    assert table.whole("count") == 3
    assert table.yes("yes") is True
    near = table.number("near")
    assert near == 1.0 and isinstance(near, float)
    assert table.table("camera").numbers("distortion") == (0.1, 2.0)
    assert [frame.text("name") for frame in table.tables("frame")] == ["a"]


def test_fallbacks(table):
    assert table.text("title", "none") == "none"
    assert table.tables("points") == []
    assert table.table("notes", optional=True).values == {}


def test_a_missing_value_names_table_and_key(table):
    with pytest.raises(CaptureError, match="`fx_px` is missing") as caught:
        table.table("camera").number("fx_px")
    assert "capture.toml, [camera]" in str(caught.value)
    with pytest.raises(CaptureError, match="`open_us` is missing") as caught:
        table.tables("frame")[0].whole("open_us")
    assert "frame number 0" in str(caught.value)


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda t: t.whole("name"), "a whole number"),
        (lambda t: t.whole("yes"), "a whole number"),
        (lambda t: t.number("yes"), "a number"),
        (lambda t: t.text("count"), "a text"),
        (lambda t: t.yes("count"), "true or false"),
        (lambda t: t.table("name"), "a table"),
    ],
)
def test_a_value_of_another_kind(table, read, kind):
    with pytest.raises(CaptureError, match=f"must be {kind}"):
        read(table)


def test_a_misspelt_key(table):
    with pytest.raises(CaptureError, match="unknown key `count`") as caught:
        table.expect_only("name", "near", "yes", "camera", "frame")
    assert "known are name, near" in str(caught.value)


def test_not_toml(tmp_path):
    (tmp_path / "capture.toml").write_text("name = ")
    with pytest.raises(CaptureError, match="not valid TOML") as caught:
        read_toml(tmp_path / "capture.toml")
    assert "Invalid value" in str(caught.value)
    with pytest.raises(CaptureError, match="file not found"):
        read_toml(tmp_path / "other.toml")


@pytest.mark.parametrize(
    "value",
    [
        *("", "a", "é", '"', "\\", "\n\t\r\b", "\x00\x1f\x7f", "]] #", "'''", "\u2028"),
        *(0, -1, 2**62, True, False),
        *(0.1 + 0.2, 1.0, 1e-17, 5e-324, 1e300, -0.0, math.inf, -math.inf),
        *([], [1, 2], [0.5, 1.0], ["a", "b"], [[1], [2]], [{"a": 1}, {"a": "x", "b": [1.5]}], [{}]),
        *({}, {"a": 1}, {"a b": {"c": [1]}, "": True}),
    ],
)
def test_what_is_written_reads_back(value):
    for values in ({"key": value}, {"table": {"key": value}}, {"two words": value, "other": 1}):
        found = tomllib.loads(toml_text(values))
        assert found == values and repr(found) == repr(dict(sorted(values.items(), key=order)))


def order(item):
    """Plain values come before tables."""
    return isinstance(item[1], dict)


def test_numpys_floats_are_floats():
    assert toml_text({"near": np.float64(0.7)}) == "near = 0.7\n"
