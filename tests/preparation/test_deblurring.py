"""Deblurring a capture brings its images nearer to the truth, and says with what thresholds."""

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

from sharpfield.core.capture import Capture, Known, Split, Thresholds
from sharpfield.core.errors import CaptureError, OptionError
from sharpfield.core.events import EventStream
from sharpfield.core.frames import Exposure
from sharpfield.events.counts import EventMotion
from sharpfield.preparation.deblurring import deblur_frames, deblur_to
from sharpfield.preparation.options import DeblurOptions
from sharpfield.preparation.thresholds import find_thresholds
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.simulation.static_capture import Rig, Timing, simulate
from sharpfield.storage.images import read_image

THRESHOLD = 0.2


@lru_cache
def capture() -> Capture:
    sensor = EventSensor(threshold_on=THRESHOLD, threshold_off=THRESHOLD)
    timing = Timing(frames=3, exposure_us=50_000, interval_us=56_000, test_every=0)
    return simulate(
        "garden", "glide", rig=Rig(size=(72, 48), event_sensor=sensor), timing=timing, seed=1
    )


def error(images: np.ndarray, truth: np.ndarray) -> float:
    return float(((images / 255.0 - truth / 255.0) ** 2).mean())


@pytest.mark.parametrize("method", ["exact", "joint"])
def test_images_come_nearer_to_the_truth(method: str) -> None:
    held = capture().needed_frames
    made = deblur_frames(capture(), DeblurOptions(method=method, threshold=THRESHOLD))
    assert made.images.shape == (3, 1, 48, 72, 3) and made.images.dtype == np.uint8
    after = error(made.images[:, 0], held.truth[made.frame])
    assert after < 0.5 * error(held.images[made.frame], held.truth[made.frame])


def test_light_is_where_the_integral_holds() -> None:
    """Averaging happened in linear light: the published method, on stored values, does worse."""
    held = capture().needed_frames
    errors = {
        method: error(
            deblur_frames(capture(), DeblurOptions(method=method, threshold=THRESHOLD)).images[
                :, 0
            ],
            held.truth,
        )
        for method in ("exact", "published")
    }
    assert errors["exact"] < errors["published"]


def test_known_thresholds_are_used_and_others_found() -> None:
    noted = replace(capture(), known=Known(thresholds=Thresholds(0.3, 0.4)))
    known = deblur_frames(noted, DeblurOptions()).found
    assert (known.thresholds.negative, known.thresholds.positive, known.source) == (
        0.3,
        0.4,
        "known",
    )
    given = deblur_frames(noted, DeblurOptions(threshold=0.17)).found
    assert (given.thresholds.negative, given.source) == (0.17, "given")
    silent = deblur_frames(replace(capture(), known=Known()), DeblurOptions()).found
    assert silent.source == "disagreement"
    assert silent.thresholds.negative == pytest.approx(THRESHOLD, rel=0.15)
    assert silent.thresholds.positive == pytest.approx(THRESHOLD, rel=0.15)


def test_single_frame_leaves_the_density_of_edges() -> None:
    held = capture().needed_frames
    one = replace(
        held, images=held.images[:1], track=held.track[:1], names=held.names[:1],
        exposure=Exposure(held.exposure.open_us[:1], held.exposure.close_us[:1]),
        truth=held.truth[:1], truth_known=held.truth_known[:1],
    )  # fmt: skip
    single = replace(capture(), frames=one, split=Split(np.array([0]), np.zeros(0, np.int64)))
    found = find_thresholds(single, EventMotion.of(single))
    assert found.source == "edge density"
    assert 0.5 * THRESHOLD < found.thresholds.positive < 2 * THRESHOLD


def test_several_instants_are_centred_in_equal_parts() -> None:
    exposure = capture().needed_frames.exposure
    made = deblur_frames(capture(), DeblurOptions(instants=5, threshold=THRESHOLD))
    expected = exposure.open_us[0] + 50_000 * (np.arange(5) + 0.5) / 5
    assert made.images.shape[1] == 5
    np.testing.assert_array_equal(made.instants_us[0], expected)
    once = deblur_frames(capture(), DeblurOptions(threshold=THRESHOLD))
    np.testing.assert_array_equal(made.images[:, 2], once.images[:, 0])


def test_only_frames_to_learn_from_that_are_blurred_are_deblurred() -> None:
    held = capture().needed_frames
    opens, closes = held.exposure.open_us.copy(), held.exposure.close_us.copy()
    opens[1] = closes[1] = held.exposure.middle_us[1]
    some = replace(
        capture(),
        frames=replace(held, exposure=Exposure(opens, closes)),
        split=Split(np.array([1, 2]), np.array([0])),
    )
    assert deblur_frames(some, DeblurOptions(threshold=THRESHOLD)).frame.tolist() == [2]


def test_colour_events_move_each_colour_by_itself() -> None:
    sensor = EventSensor(threshold_on=THRESHOLD, threshold_off=THRESHOLD, bayer="RGGB")
    timing = Timing(frames=2, exposure_us=50_000, interval_us=56_000, test_every=0)
    coloured = simulate(
        "garden", "glide", rig=Rig(size=(72, 48), event_sensor=sensor), timing=timing, seed=1
    )
    held = coloured.needed_frames
    made = deblur_frames(coloured, DeblurOptions(threshold=THRESHOLD))
    before, after = error(held.images, held.truth), error(made.images[:, 0], held.truth)
    assert after < before


def test_folder_holds_images_a_sheet_and_numbers(tmp_path: Path) -> None:
    made = deblur_to(capture(), tmp_path / "out", DeblurOptions(threshold=THRESHOLD))
    about = json.loads((tmp_path / "out" / "deblur.json").read_text())
    names = [name for row in about["frames"] for name in row["images"]]
    for name, images in zip(names, made.images, strict=True):
        np.testing.assert_array_equal(read_image(tmp_path / "out" / name), images[0])
    assert about["thresholds"]["negative"] == THRESHOLD and about["thresholds"]["from"] == "given"
    assert about["mean"]["after"]["psnr"] > about["mean"]["before"]["psnr"] + 3
    assert about["mean"]["after"]["edge_density"] < about["mean"]["before"]["edge_density"]
    sheet = read_image(tmp_path / "out" / "contact.png")
    assert sheet.shape == (3 * 48 + 2 * 4, 3 * 72 + 2 * 4, 3)


def test_grey_frames_and_rectified_events() -> None:
    held, events = capture().needed_frames, capture().needed_events
    grey = torch.as_tensor(held.images).float() @ torch.tensor([0.299, 0.587, 0.114])
    moved = EventStream(
        events.x.astype(np.float32), events.y.astype(np.float32), events.t_us, events.p, 72, 48
    )
    images = grey.round().numpy().astype(np.uint8)[..., None]
    both = replace(
        capture(), frames=replace(held, images=images, truth=None, truth_known=None), events=moved
    )
    made = deblur_frames(both, DeblurOptions(threshold=THRESHOLD))
    coloured = deblur_frames(capture(), DeblurOptions(threshold=THRESHOLD))
    weights = np.array([0.299, 0.587, 0.114])
    assert np.abs(made.images[..., 0] - coloured.images @ weights).mean() < 3


def test_capture_without_events_is_refused() -> None:
    with pytest.raises(CaptureError, match="this needs events, and the capture has none"):
        deblur_frames(capture().without(events=True), DeblurOptions())


def test_events_of_another_size_are_refused() -> None:
    other = replace(capture().needed_events, width=80)
    with pytest.raises(CaptureError, match="events 80x48, frames 72x48"):
        deblur_frames(replace(capture(), events=other), DeblurOptions())


def test_sharp_frames_alone_are_refused() -> None:
    held = capture().needed_frames
    middle = held.exposure.middle_us
    sharp = replace(capture(), frames=replace(held, exposure=Exposure(middle, middle)))
    with pytest.raises(CaptureError, match="no frame to deblur has an exposure"):
        deblur_frames(sharp, DeblurOptions())


def test_several_instants_need_the_exact_method() -> None:
    with pytest.raises(OptionError, match="3 with method joint"):
        DeblurOptions(method="joint", instants=3)
