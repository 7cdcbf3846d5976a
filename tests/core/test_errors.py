import pytest

from sharpfield.core.errors import (
    CaptureError,
    MissingExtra,
    OptionError,
    RunError,
    ShapeError,
    SharpfieldError,
)


def test_a_message_says_what_where_got_and_what_to_do():
    error = CaptureError(
        "frames 12 and 13 overlap in time",
        where="garden/capture.toml",
        got="12 closes late",
        do="check `exposure_us`",
    )
    assert str(error) == (
        "CaptureError: frames 12 and 13 overlap in time\n"
        "  where  garden/capture.toml\n"
        "  got    12 closes late\n"
        "  do     check `exposure_us`"
    )


def test_what_is_not_known_is_not_said():
    assert str(RunError("cannot be read")) == "RunError: cannot be read"
    assert str(OptionError("negative", got=-1)) == "OptionError: negative\n  got    -1"


def test_zero_is_a_finding():
    assert "got    0" in str(ShapeError("too few", got=0))


@pytest.mark.parametrize("kind", [CaptureError, OptionError, RunError, ShapeError])
def test_one_tree(kind: type[SharpfieldError]):
    with pytest.raises(SharpfieldError, match=kind.__name__):
        raise kind("wrong")


def test_a_missing_package_names_its_extra():
    error = MissingExtra("viser", extra="viewer", purpose="the viewer")
    assert isinstance(error, SharpfieldError)
    assert str(error) == (
        "MissingExtra: the viewer needs the package 'viser'\n"
        "  do     pip install 'sharpfield[viewer]'"
    )
