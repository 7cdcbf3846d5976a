"""The ingest command: what it makes, what it says, what it refuses."""

import numpy as np
import pytest

from sharpfield.captures.native import layout as native
from sharpfield.storage.event_writer import write_events
from sharpfield.storage.images import write_image
from tests.cli.command import run
from tests.streams import HEIGHT, WIDTH, random_events


@pytest.fixture
def recorded(tmp_path):
    write_events(tmp_path / "events.h5", random_events(2000))
    for i in range(3):
        write_image(tmp_path / "seen" / f"{i}.png", np.full((HEIGHT, WIDTH, 1), 9 * i, np.uint8))
    return tmp_path


def test_a_capture_of_two_recordings(recorded, capsys):
    out = recorded / "garden"
    words = ("--fps", 50, "--exposure", "0.5", "--clock", "same", "--to", 60)
    assert run("ingest", recorded / "events.h5", recorded / "seen", "--out", out, *words) == 0
    said = capsys.readouterr().out.replace("\n", " ")
    assert "3 frames and" in said and "left out:" in said
    assert "not known yet: poses, intrinsics, bounds" in said
    assert "sharpfield poses" in said
    found = native.read_unposed(out)
    assert found.needed_frames.exposure.window(1) == (20_000, 30_000)
    assert found.clock.origin_us + found.clock.span_us <= 62_000
    assert run("inspect", out) == 0
    assert run("train", "nerf", out, "--out", recorded / "run") == 2
    assert "the poses of the camera are unknown" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--columns", "xytp"), "the option `columns` has no effect"),
        (("--fps", 5), "the option `fps` has no effect"),
        (("--layout", "evt9"), "unknown format"),
        (("--rectify",), "lenses are not known"),
        (("--bayer", "RGB"), "unknown colour filter"),
        (("--from", 100, "--to", 50), "nothing was recorded in this time range"),
    ],
)
def test_what_makes_no_sense_is_refused(recorded, capsys, words, message):
    assert run("ingest", recorded / "events.h5", "--out", recorded / "garden", *words) == 2
    assert message in capsys.readouterr().err
    assert not (recorded / "garden").exists()


def test_one_recording_or_two(recorded, capsys):
    assert run("ingest", "--out", recorded / "garden") == 2
    assert "give one recording, or two" in capsys.readouterr().err
