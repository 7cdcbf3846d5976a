import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import spearmanr

from sharpfield.core.capture import Split
from sharpfield.core.errors import OptionError
from sharpfield.preparation.options import QualityOptions
from sharpfield.preparation.quality import as_table, measure_quality, quality_to, rank_correlation
from sharpfield.simulation.room_capture import RoomTiming, simulate_room
from sharpfield.simulation.static_capture import Rig
from sharpfield.storage.images import read_image


@pytest.fixture(scope="module")
def walked():
    return simulate_room(rig=Rig(size=(48, 36)), timing=RoomTiming(frames=9))


def test_what_is_written_is_what_is_said(walked, tmp_path):
    found, measured_by = measure_quality(walked, QualityOptions())
    quality_to(walked, found, measured_by, tmp_path)
    told = json.loads((tmp_path / "quality.json").read_text())
    assert told == as_table(walked, found, measured_by) and told["told_by"] == "depth"
    assert [row["name"] for row in told["frames"]] == [walked.frames.names[i] for i in found.frames]
    assert set(told["frames"][0]) == {"name", "score", "weight", "true_blur_px"}
    np.testing.assert_array_equal(np.load(tmp_path / "weights.npy"), found.weights)
    assert read_image(tmp_path / "ranking.png").shape[-1] == 3


def test_without_truth_nothing_is_said_about_it(walked):
    blind = replace(walked, frames=replace(walked.frames, blur_px=None), depth=None)
    found, measured_by = measure_quality(blind, QualityOptions(every_frame=True))
    table = as_table(blind, found, measured_by)
    assert measured_by == "flow" and len(table["frames"]) == 9
    assert set(table["frames"][0]) == {"name", "score", "weight"}
    assert "rank_correlation" not in table


def test_ranks_are_those_of_scipy():
    draw = np.random.default_rng(0)
    a, b = draw.integers(0, 9, 40).astype(float), draw.normal(size=40)
    assert rank_correlation(a, b) == pytest.approx(spearmanr(a, b)[0])
    assert rank_correlation(np.ones(4), b[:4]) == 0


def test_one_frame_cannot_be_judged(walked):
    alone = replace(walked, split=Split(np.array([3]), np.array([1])))
    with pytest.raises(OptionError, match="fewer than two"):
        measure_quality(alone, QualityOptions())
