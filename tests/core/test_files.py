import json
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sharpfield.core import files
from sharpfield.core.files import replacing, replacing_folder, write_json


def test_the_new_file_takes_the_place_of_the_old(tmp_path: Path):
    path = tmp_path / "run" / "log.json"
    for text in ("old", "new"):
        with replacing(path) as temporary:
            assert temporary.parent == path.parent and temporary.suffix == ".json"
            temporary.write_text(text)
        assert path.read_text() == text
    assert list(path.parent.iterdir()) == [path]


def test_plain_values_are_written_as_lines_in_place_of_what_was_there(tmp_path: Path):
    path = tmp_path / "new" / "about.json"
    for about in ({"loss": 0.5, "names": ["a"]}, [None, True]):
        write_json(path, about)
        assert json.loads(path.read_text()) == about
    assert path.read_text() == "[\n  null,\n  true\n]\n"


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path):
    write_json(tmp_path / "a.json", {"step": 1})
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_json(tmp_path / "a.json", {"step": object()})
    assert json.loads((tmp_path / "a.json").read_text()) == {"step": 1}
    assert list(tmp_path.iterdir()) == [tmp_path / "a.json"]


def test_an_exception_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "log.json"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="half way"), replacing(path) as temporary:
        temporary.write_text("ne")
        raise RuntimeError("half way")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_kill_leaves_the_old_file(tmp_path: Path):
    path = tmp_path / "log.json"
    path.write_text("old")
    script = (
        "import os, pathlib, runpy, signal, sys\n"
        "replacing = runpy.run_path(sys.argv[1])['replacing']\n"
        "with replacing(pathlib.Path(sys.argv[2])) as temporary:\n"
        "    temporary.write_text('ne')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, files.__file__, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_text() == "old"


def test_files_needs_nothing_but_the_standard_library():
    """Else the test above would wait for torch."""
    assert "replacing" in runpy.run_path(str(files.__file__))


def test_others_may_read_what_the_umask_allows(tmp_path: Path):
    path = tmp_path / "page.html"
    with replacing(path) as temporary:
        temporary.write_text("")
    plain = tmp_path / "plain"
    plain.write_text("")
    assert path.stat().st_mode == plain.stat().st_mode


def test_the_new_folder_takes_the_place_of_the_old(tmp_path: Path):
    path = tmp_path / "capture"
    for name in ("old", "new"):
        with replacing_folder(path) as temporary:
            (temporary / name).write_text(name)
        assert [p.name for p in path.iterdir()] == [name]
    assert list(tmp_path.iterdir()) == [path]


def test_an_exception_leaves_the_old_folder(tmp_path: Path):
    path = tmp_path / "capture"
    path.mkdir()
    (path / "frame").write_text("old")
    with pytest.raises(RuntimeError, match="half way"), replacing_folder(path) as temporary:
        (temporary / "frame").write_text("ne")
        raise RuntimeError("half way")
    assert (path / "frame").read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_cannot_move_in_leaves_the_old_one(tmp_path: Path, monkeypatch):
    path = tmp_path / "capture"
    path.mkdir()
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.name.endswith("-old") or target.name.endswith("-old"):
            return rename(self, target)
        raise OSError("disk full")

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OSError, match="disk full"), replacing_folder(path):
        pass
    assert list(tmp_path.iterdir()) == [path]
