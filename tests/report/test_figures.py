import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sharpfield.core.capture import Known, Split
from sharpfield.geometry.trajectory import Still
from sharpfield.report.figures import curves_figure, read_log, timeline_figure, trajectory_figure
from tests.evaluation.fake import capture


def still_photos():
    """Photos without a path: every frame on a track of its own."""
    whole = capture(events=0)
    frames = whole.needed_frames
    poses = whole.frame_pose(np.arange(6)).double().numpy()
    return replace(
        whole,
        frames=replace(frames, track=np.arange(6)),
        trajectory=Still(poses),
        known=Known(motion="unknown"),
    )


def test_drawings_fit_any_page():
    for svg in (trajectory_figure(capture()), timeline_figure(capture())):
        assert svg is not None
        root = ElementTree.fromstring(svg)
        assert root.attrib["role"] == "img" and root.attrib["aria-label"]
        assert "width" not in root.attrib and "viewBox" in root.attrib
        assert "currentColor" in svg and "#010203" not in svg
        assert "<metadata>" not in svg


def test_names_differ_between_drawings():
    def names(svg: str | None) -> set[str]:
        return {part.get("id", "") for part in ElementTree.fromstring(svg or "").iter()} - {""}

    assert not names(trajectory_figure(capture())) & names(timeline_figure(capture()))


@pytest.mark.parametrize(
    "odd",
    [
        capture().without(frames=True),
        capture().without(events=True),
        capture(test=()),
        replace(capture(), split=Split(np.arange(0), np.arange(6))),
        still_photos(),
    ],
)
def test_any_capture_can_be_drawn(odd):
    assert trajectory_figure(odd).startswith("<svg")
    timeline_figure(odd)


def test_made_up_times_are_not_drawn():
    assert timeline_figure(still_photos()) is None


def test_a_log_with_gaps_is_drawn(tmp_path: Path):
    (tmp_path / "log.csv").write_text(
        "step,seconds,total,blur,validation\n19,1.0,0.5,0.4,\n39,2.0,0.3,,21.5\n59,3.0,0.2,0.1,\n"
    )
    columns = read_log(tmp_path / "log.csv")
    assert columns["validation"] == [None, 21.5, None] and columns["step"] == [19, 39, 59]
    svg = curves_figure(tmp_path / "log.csv")
    assert svg is not None
    for text in ("losses", "blur", "validation"):
        assert text in svg


def test_no_log_no_curves(tmp_path: Path):
    assert curves_figure(tmp_path / "log.csv") is None
    (tmp_path / "log.csv").write_text("step,seconds,total\n")
    assert curves_figure(tmp_path / "log.csv") is None


def test_heavy_libraries_are_imported_when_they_are_used():
    program = (
        "import sys; from sharpfield.evaluation import report; from sharpfield.preparation import"
        " quality; from sharpfield.preparation.doctor import checkup;"
        " print(sorted({'matplotlib', 'av', 'jinja2'} & set(sys.modules)))"
    )
    words, source = [sys.executable, "-c", program], Path(__file__).parents[2] / "src"
    there = os.environ | {"PYTHONPATH": str(source)}
    found = subprocess.run(words, capture_output=True, text=True, check=True, env=there)
    assert found.stdout.strip() == "[]"
