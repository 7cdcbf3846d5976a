import json

import pytest

from sharpfield.core.errors import MissingExtra, need


def test_an_installed_package_is_imported():
    assert need("json", extra="io", purpose="reading") is json
    inner = need("importlib.metadata", extra="io", purpose="reading")
    assert inner.__name__ == "importlib.metadata"


def test_a_missing_one_says_what_to_install():
    with pytest.raises(MissingExtra) as missing:
        need("no_such_package", extra="io", purpose="reading rosbags")
    assert str(missing.value) == (
        "MissingExtra: reading rosbags needs the package 'no_such_package'\n"
        "  do     pip install 'sharpfield[io]'"
    )


def test_a_package_that_fails_inside_is_not_called_missing(tmp_path, monkeypatch):
    (tmp_path / "broken_package.py").write_text("import another_that_is_missing")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="another_that_is_missing"):
        need("broken_package", extra="io", purpose="reading")
