import json

import numpy as np
import pytest

from sharpfield.captures.read import read_capture
from sharpfield.cli.commands import main


def run(*words: str) -> None:
    main([str(word) for word in words])


def test_a_room_is_walked_through_and_judged(tmp_path, capsys):
    room = tmp_path / "room"
    run("simulate", "--out", room, "--scene", "room", "--frames", "9", "--size", "48x36")
    capture = read_capture(room)
    assert capture.depth is not None and len(capture.frames) == 9 and capture.events is None
    capsys.readouterr()
    run("quality", room, "--json", "--out", tmp_path / "judged")
    told = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in told["frames"]] == [f"{i:04d}" for i in range(1, 8)]
    assert all({"name", "score", "weight"} <= row.keys() for row in told["frames"])
    assert (tmp_path / "judged" / "ranking.png").is_file()
    run("quality", room)
    assert "Rank correlation" in capsys.readouterr().out
    run("blur", room / "truth", "--out", tmp_path / "b", "--k", "5", "9", "--probability", "1")
    assert "9 of 9 images were blurred" in capsys.readouterr().out


def test_a_room_in_the_layout_of_scannet(tmp_path):
    room = tmp_path / "room"
    words = ("--frames", "7", "--size", "32x24", "--blurry", "1", "--layout", "scannet")
    run("simulate", "--out", room, "--scene", "room", *words)
    capture = read_capture(room)
    assert capture.source == "scannet" and capture.frames.encoding == "srgb"
    np.testing.assert_array_equal(capture.split.train, [0, 5])
    assert (capture.frames.blur_px > 0).tolist() == [True, *[False] * 4, True, False]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--blurry", "2"), "share of blurry frames lies between 0 and 1"),
        (("--most-change", "0.1"), "a walk has even steps"),
    ],
)
def test_a_walk_that_cannot_be(tmp_path, capsys, words, message):
    with pytest.raises(SystemExit) as left:
        run("simulate", "--out", tmp_path / "room", "--scene", "room", *words)
    assert left.value.code == 2 and message in capsys.readouterr().err
