import json

import pytest
import torch

from sharpfield.evaluation.measure import evaluate
from sharpfield.evaluation.scores import mean, methods_table, score, view_metrics, views_table
from sharpfield.metrics.registry import HIGHEST_PSNR
from tests.evaluation.fake import Sky, capture


def test_equal_images_have_the_highest_psnr_and_stay_finite():
    image = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    found = score(image, image, view_metrics())
    assert found["psnr"] == HIGHEST_PSNR
    assert found["ssim"] == pytest.approx(1) and found["lpips"] is None


def test_mean_is_over_images_and_none_where_one_lacks_it():
    rows = [
        {"psnr": 20.0, "ssim": 0.5, "ssim_paper": 0.4, "lpips": None},
        {"psnr": 30.0, "ssim": 0.7, "ssim_paper": 0.6, "lpips": 0.1},
    ]
    found = mean(rows, view_metrics())
    assert found == {
        "psnr": 25.0,
        "ssim": pytest.approx(0.6),
        "ssim_paper": pytest.approx(0.5),
        "lpips": None,
    }


def test_mean_of_no_images_is_none():
    assert set(mean([], view_metrics()).values()) == {None}


def test_a_metric_of_another_package_reaches_metrics_json_and_tables(tmp_path, monkeypatch):
    installed = tmp_path / "installed"
    about = installed / "strangers-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: strangers\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[sharpfield.metrics]\nmae = strangers_metric:MAE\n")
    (installed / "strangers_metric.py").write_text(
        "from sharpfield.metrics.registry import Metric\n"
        "MAE = Metric('mae', 'MAE', 'mean absolute difference', 'lower', '{:.3f}',\n"
        "             lambda image, reference: float((image - reference).abs().mean()))\n"
    )
    monkeypatch.syspath_prepend(installed)
    evaluate(Sky(capture(), gain=0.5), capture(), tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["protocol"]["mae"] == "mean absolute difference"
    value = f"{metrics['mean']['mae']:.3f}"
    assert views_table(metrics["views"], metrics["mean"]).columns[-1] == "MAE"
    better = metrics | {"baselines": {"zero": {"mean": {"mae": 0.0}}}}
    table = methods_table(better)
    column = table.columns.index("MAE")
    assert [row[column] for row in table.rows] == [value, "0.000"] and (1, column) in table.best
