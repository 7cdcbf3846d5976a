"""Videos of held-out event cameras, and their part of the report."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np

from sharpfield.evaluation.event_scores import (
    GAP_PX,
    VIDEO_WINDOWS,
    events_section,
    write_event_videos,
)
from sharpfield.evaluation.measure import evaluate
from sharpfield.evaluation.report import RunDescription, write_report
from tests.evaluation.test_event_scores import Scene
from tests.evaluation.test_report import checked
from tests.recipes.moving import tiny_moving


def frames_of(path: Path) -> np.ndarray:
    with av.open(path) as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


def test_a_video_shows_what_was_recorded_beside_what_is_predicted(tmp_path: Path):
    moving = tiny_moving()
    (told,) = write_event_videos(Scene(moving, 1.0), moving, tmp_path)
    video = frames_of(tmp_path / told["video"])
    assert video.shape == (VIDEO_WINDOWS, 240, 2 * 240 + GAP_PX, 3)
    recorded, predicted = (part.astype(int) for part in (video[:, :, :240], video[:, :, -240:]))
    assert brighter(recorded).any() and brighter(-recorded).any()
    # of the true scene: what is predicted happened; remainders at both ends are left out
    assert brighter(recorded)[brighter(predicted)].mean() > 0.7
    assert not brighter(-recorded)[brighter(predicted)].mean() > 0.05
    assert not brighter(frames_of_nothing(tmp_path)).any()


def brighter(part: np.ndarray) -> np.ndarray:
    """Where it is red; of what is negated, where it is blue."""
    return part[..., 0] - part[..., 2] > 80


def frames_of_nothing(folder: Path) -> np.ndarray:
    moving = tiny_moving()
    (told,) = write_event_videos(Scene(moving, 0.0), moving, folder / "nothing")
    return frames_of(folder / "nothing" / told["video"])[:, :, -240:].astype(int)


def test_the_report_plays_it(tmp_path: Path):
    moving = tiny_moving()
    metrics = evaluate(Scene(moving, 1.0), moving, tmp_path)
    assert [one["video"] for one in metrics["events"]["videos"]] == ["renders/events/03.mp4"]
    told = checked(write_report(tmp_path, moving, metrics, RunDescription("a moving scene")))
    assert sum(one.startswith("data:video/mp4;base64,") for one in told.references) == 1
    for text in ("Held-out event cameras", "Camera 3", "event PSNR (dB)", "1/32 of the capture"):
        assert text in told.text, text


def test_without_held_out_events_there_is_no_video(tmp_path: Path):
    still = replace(tiny_moving(), test_events=None)
    assert write_event_videos(Scene(still, 1.0), still, tmp_path) == []
    assert events_section(tmp_path, {"mean": {}}) is None
    assert not list(tmp_path.iterdir())
