from dataclasses import replace

import numpy as np
import pytest

from sharpfield.captures.native import layout as native
from sharpfield.captures.native.known import known_from_notes, known_table, read_known
from sharpfield.core.capture import Known, Thresholds
from sharpfield.core.errors import CaptureError
from sharpfield.storage.toml_tables import Table

FULL = Known(
    poses="unknown",
    motion="unknown",
    intrinsics="estimated",
    bounds="estimated",
    thresholds=Thresholds(0.17, 0.31, "estimated"),
    log_floor=0.0,
    refractory_us=0.0,
    background="white",
    reference_poses="trajectory",
)


@pytest.mark.parametrize("known", [Known(), FULL, Known(thresholds=Thresholds(0.2, 0.3))])
def test_a_table_there_and_back(known):
    assert read_known(Table(known_table(known), "capture.toml, [known]")) == known


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"pose": "known"}, "unknown key `pose`"),
        ({"poses": "guessed"}, "unknown value of `poses`"),
        ({"threshold_positive": 0.2}, "`threshold_negative` is missing"),
        (
            {"threshold_positive": 0.2, "threshold_negative": 0.2, "thresholds": "unknown"},
            "unknown value of `thresholds`",
        ),
    ],
)
def test_wrong_tables_are_refused_with_their_place(table, message):
    with pytest.raises(CaptureError, match=message) as caught:
        read_known(Table(table, "capture.toml, [known]"))
    assert "capture.toml, [known]" in str(caught.value)


def test_notes_of_older_captures():
    notes = {
        "poses": "unknown",
        "motion": "none",
        "bounds": "guessed from where the cameras look",
        "threshold_off": np.array([[0.1, 0.3], [0.2, 0.9]]),
        "threshold_on": 0.25,
        "log_floor": 1e-3,
        "refractory_us": 50.0,
        "reference_poses": "trajectory",
        "background": "white",
        "lux": 3.0,
    }
    known, left = known_from_notes(notes)
    assert known == Known(
        poses="unknown",
        bounds="estimated",
        thresholds=Thresholds(0.25, 0.25),
        log_floor=1e-3,
        refractory_us=50.0,
        background="white",
        reference_poses="trajectory",
    )
    assert left == {"bounds": notes["bounds"], "lux": 3.0}
    assert known_from_notes({"threshold_on": 0.3})[0].thresholds == Thresholds(0.2, 0.3)


def test_a_capture_written_before_the_table_existed(panning, tmp_path):
    blur = np.linspace(0, 3, len(panning.frames))
    old = replace(panning, notes={"threshold_on": 0.3, "threshold_off": 0.1, "blur_px": blur})
    native.write(old, tmp_path)
    text = (tmp_path / "capture.toml").read_text()
    start, end = text.index("[known]"), text.index("[notes]")
    (tmp_path / "capture.toml").write_text(text[:start] + text[end:])
    found = native.read(tmp_path)
    assert found.known == Known(thresholds=Thresholds(0.1, 0.3))
    np.testing.assert_array_equal(found.frames.blur_px, blur)
    assert found.notes == {}
