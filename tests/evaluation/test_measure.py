import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sharpfield.core.capture import Split
from sharpfield.core.errors import OptionError, RunError
from sharpfield.core.protocols import Model
from sharpfield.evaluation.measure import EvaluationOptions, evaluate
from sharpfield.evaluation.report import RunDescription, write_report
from sharpfield.evaluation.views import validation
from sharpfield.metrics.lpips import BACKBONES, Lpips
from tests.evaluation.fake import CAMERA, Sky, capture


def random_lpips() -> Lpips:
    generator = torch.Generator().manual_seed(0)
    kernels, entering = [], 3
    for layer in BACKBONES["alex"]:
        shape = (layer.channels, entering, layer.size, layer.size)
        weight = 0.05 * torch.randn(shape, generator=generator)
        kernels.append((weight, torch.zeros(layer.channels)))
        entering = layer.channels
    linear = tuple(torch.rand(layer.channels, generator=generator) for layer in BACKBONES["alex"])
    return Lpips("alex", tuple(kernels), linear, {"backbone": "b", "linear": "l"})


def test_the_fake_is_a_model():
    assert isinstance(Sky(capture()), Model)


# laws


def test_a_perfect_model_scores_as_well_as_eight_bits_allow(tmp_path: Path):
    metrics = evaluate(Sky(capture()), capture(), tmp_path)
    # Rounding to 8 bit has a mean squared error of 1/12 of a step squared: 58.9 dB.
    assert metrics["mean"]["psnr"] == pytest.approx(58.9, abs=0.5)
    assert metrics["mean"]["ssim"] > 0.999 and metrics["mean"]["ssim_paper"] > 0.99
    assert [view["name"] for view in metrics["views"]] == ["00", "04"]
    assert {view["reference"] for view in metrics["views"]} == {"sharp image"}
    train = metrics["train_views"]
    assert train["count"] == 4
    assert train["mean"]["psnr"] == pytest.approx(58.9, abs=0.5)
    assert train["input"]["mean"]["psnr"] < 40
    for view in train["views"]:
        sharpness = view["sharpness"]
        assert sharpness["result"] == pytest.approx(sharpness["truth"], rel=0.05)
        assert sharpness["input"] < sharpness["truth"]


def test_a_model_in_colour_is_compared_with_grey_frames_by_its_luma(tmp_path: Path):
    one = capture()
    frames = one.needed_frames
    middle = {"images": frames.images[..., 1:2], "truth": frames.truth[..., 1:2]}
    grey = replace(one, frames=replace(frames, **middle))
    metrics = evaluate(Sky(grey), grey, tmp_path)
    assert metrics["protocol"]["compared_as"] == "luma"
    assert 5 < metrics["mean"]["psnr"] < 50
    write_report(tmp_path, grey, metrics, RunDescription("grey"))


def test_validation_says_what_evaluation_says(tmp_path: Path):
    score = validation(capture())
    assert score is not None
    metrics = evaluate(Sky(capture(), gain=0.8), capture(), tmp_path)
    assert score(Sky(capture(), gain=0.8)) == pytest.approx(metrics["mean"]["psnr"], abs=1e-3)
    blind = capture().without(frames=True)
    metrics = evaluate(
        Sky(blind, gain=0.2), capture(), tmp_path, options=EvaluationOptions(train_views=0)
    )
    assert score(Sky(blind, gain=0.2)) == pytest.approx(metrics["mean"]["psnr"], abs=1e-3)
    assert validation(capture(test=())) is None


def test_the_file_is_what_was_returned(tmp_path: Path):
    metrics = evaluate(Sky(capture()), capture(), tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert {"protocol", "mean", "views", "train_views", "train"} == metrics.keys()


def test_images_are_written_and_named(tmp_path: Path):
    whole = capture()
    metrics = evaluate(Sky(whole), whole, tmp_path)
    for view in [*metrics["views"], *metrics["train_views"]["views"]]:
        assert cv2.imread(str(tmp_path / view["depth"])).shape == (32, 40, 3)
        written = cv2.imread(str(tmp_path / view["image"]))[..., ::-1].astype(int)
        frames = whole.needed_frames
        wanted = frames.truth if "input" in view else frames.images
        assert wanted is not None
        assert np.abs(written - wanted[view["frame"]]).max() <= 1


def test_a_worse_model_scores_worse(tmp_path: Path):
    good = evaluate(Sky(capture()), capture(), tmp_path)["mean"]
    dim = evaluate(Sky(capture(), gain=0.8), capture(), tmp_path)["mean"]
    assert dim["psnr"] < good["psnr"] - 20 and dim["ssim_paper"] < good["ssim_paper"]


def test_given_poses_replace_those_of_the_capture(tmp_path: Path):
    whole = capture()
    elsewhere = {0: torch.eye(3, 4) + torch.tensor([0.0, 0, 0, 0.3])}
    metrics = evaluate(
        Sky(whole),
        whole,
        tmp_path,
        options=EvaluationOptions(poses=elsewhere, stated={"pose_refinement": "by hand"}),
    )
    assert metrics["views"][0]["psnr"] < 30 < 50 < metrics["views"][1]["psnr"]
    assert metrics["protocol"]["pose_refinement"] == "by hand"


# what a capture may lack


def test_without_held_out_frames_only_training_views_count(tmp_path: Path):
    metrics = evaluate(Sky(capture(test=())), capture(test=()), tmp_path)
    assert metrics["mean"] == dict.fromkeys(("psnr", "ssim", "ssim_paper", "lpips"))
    assert metrics["views"] == [] and metrics["train_views"]["count"] == 6
    assert metrics["protocol"]["why_no_scores"] == "the capture holds no frame out"


def test_without_truth_a_few_training_views_are_shown_but_not_scored(tmp_path: Path):
    metrics = evaluate(Sky(capture()), capture(truth=False), tmp_path)
    train = metrics["train_views"]
    assert len(train["views"]) == 3 and train["count"] == 0
    assert train["mean"]["psnr"] is None and train["input"]["mean"]["psnr"] is None
    assert all(view["psnr"] is None and "input" not in view for view in train["views"])
    assert metrics["mean"]["psnr"] > 50


def test_a_blurred_reference_is_called_so(tmp_path: Path):
    whole = replace(capture(truth=False), split=Split(np.arange(5), np.array([5])))
    metrics = evaluate(Sky(whole), whole, tmp_path)
    assert metrics["protocol"]["references"] == {"blurred image": 1}


def test_without_any_frames_there_is_nothing_to_compare_with(tmp_path: Path):
    blind = capture().without(frames=True)
    metrics = evaluate(Sky(blind), blind, tmp_path)
    assert metrics["views"] == [] and metrics["mean"]["psnr"] is None
    assert "no frames" in metrics["protocol"]["why_no_scores"]


@pytest.mark.parametrize("bayer", ["RGGB", ""])
def test_events_alone_are_aligned_in_log_intensity(tmp_path: Path, bayer: str):
    """A wrong gain and power of the light are what events cannot tell, and cost nothing."""
    whole = capture()
    blind = whole.without(frames=True)
    blind = replace(blind, events=replace(blind.needed_events, bayer=bayer))
    metrics = evaluate(Sky(blind, gain=3.0, power=1.7), whole, tmp_path)
    alignment = metrics["protocol"]["alignment"]
    if bayer:
        assert metrics["mean"]["psnr"] > 55
        assert alignment["gain"] == pytest.approx([1 / (2.2 * 1.7)] * 3, rel=0.01)
    else:
        assert metrics["mean"]["psnr"] > 20 and len(alignment["gain"]) == 1
        assert metrics["protocol"]["compared_as"] == "luma"


def test_a_model_whose_recipe_left_the_frames_out_can_be_called_blind(tmp_path: Path):
    dim = Sky(capture(), gain=0.5)
    plain = evaluate(dim, capture(), tmp_path)
    blind = evaluate(dim, capture(), tmp_path, options=EvaluationOptions(events_only=True))
    assert plain["protocol"]["alignment"] is None
    assert blind["protocol"]["alignment"] is not None
    assert blind["mean"]["psnr"] > plain["mean"]["psnr"]


def test_a_model_that_saw_frames_is_not_aligned(tmp_path: Path):
    metrics = evaluate(Sky(capture()), capture(), tmp_path)
    assert metrics["protocol"]["alignment"] is None
    assert metrics["protocol"]["compared_as"] == "all channels"


# options


def test_lpips_is_null_with_a_reason_or_a_number_with_its_weights(tmp_path: Path):
    without = evaluate(Sky(capture()), capture(), tmp_path)
    assert without["mean"]["lpips"] is None
    assert without["protocol"]["lpips"]["computed"] is False
    assert "alexnet-owt-7be5be79.pth" in without["protocol"]["lpips"]["enable"]
    measuring = EvaluationOptions(lpips=random_lpips())
    found = evaluate(Sky(capture(), gain=0.5), capture(), tmp_path, options=measuring)
    assert found["mean"]["lpips"] > 0
    assert found["protocol"]["lpips"]["backbone"] == "b"


def test_the_number_of_training_views_can_be_limited(tmp_path: Path):
    metrics = evaluate(
        Sky(capture()), capture(), tmp_path, options=EvaluationOptions(train_views=2)
    )
    assert [view["frame"] for view in metrics["train_views"]["views"]] == [1, 5]


def test_cost_of_training_and_baselines_are_kept(tmp_path: Path):
    (tmp_path / "training.json").write_text(
        '{"steps": 7, "seconds": 1.5, "peak_memory_mb": 99.0, "device": "cpu"}'
    )
    baselines = {"nerf": {"mean": {"psnr": 20.0}}}
    metrics = evaluate(Sky(capture()), capture(), tmp_path, baselines=baselines)
    assert metrics["train"] == {"steps": 7, "seconds": 1.5, "peak_memory_mb": 99.0}
    assert metrics["baselines"] == baselines


def test_progress_counts_all_pixels(tmp_path: Path):
    said: list[tuple[int, int]] = []
    evaluate(
        Sky(capture()),
        capture(),
        tmp_path,
        options=EvaluationOptions(chunk=500),
        progress=lambda *done: said.append(done),
    )
    total = 6 * CAMERA.width * CAMERA.height
    assert said[-1] == (total, total)
    assert said == sorted(said) and {of for _, of in said} == {total}


# errors


def test_another_image_size_is_refused(tmp_path: Path):
    whole = capture()
    small = replace(whole, camera=CAMERA.scaled(0.5), frames=None)
    with pytest.raises(OptionError, match=r"another image size[\s\S]*\(40, 32\)[\s\S]*\(20, 16\)"):
        evaluate(Sky(small), whole, tmp_path)


def test_colours_that_are_not_numbers_are_refused(tmp_path: Path):
    with pytest.raises(RunError, match=r"not finite[\s\S]*frame 00[\s\S]*3840 of 3840"):
        evaluate(Sky(capture(), gain=float("nan")), capture(), tmp_path)
    assert not (tmp_path / "metrics.json").exists()


def test_a_damaged_ledger_is_named(tmp_path: Path):
    (tmp_path / "training.json").write_text('{"steps": ')
    with pytest.raises(RunError, match=r"cannot be read[\s\S]*training\.json"):
        evaluate(Sky(capture()), capture(), tmp_path)
