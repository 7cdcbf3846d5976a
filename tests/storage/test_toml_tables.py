import pytest

from sharpfield.core.errors import CaptureError
from sharpfield.storage.toml_tables import read_toml

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
