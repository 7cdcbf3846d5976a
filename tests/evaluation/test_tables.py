from sharpfield.evaluation.scores import methods_table, reported_metrics, views_table
from sharpfield.report.page import markdown

MEAN = {"psnr": 31.239, "ssim": 0.91234, "ssim_paper": 0.9, "lpips": None}
METRICS = {
    "mean": MEAN,
    "baselines": {
        "nerf": {"mean": {"psnr": 22.0, "ssim": 0.6, "ssim_paper": 0.95, "lpips": None}},
        "<edi>": {"mean": {"psnr": 28.0, "ssim": 0.8}},
    },
}


def test_methods_stand_beside_each_other_with_the_best_marked():
    assert markdown(methods_table(METRICS)) == (
        "| method   | PSNR (dB) | SSIM       | SSIM (paper) |\n"
        "|:---------|----------:|-----------:|-------------:|\n"
        "| this run | **31.24** | **0.9123** | 0.9000       |\n"
        "| nerf     | 22.00     | 0.6000     | **0.9500**   |\n"
        "| <edi>    | 28.00     | 0.8000     | –            |"
    )


def test_lpips_is_better_when_lower():
    metrics = {"mean": {"lpips": 0.2}, "baselines": {"other": {"mean": {"lpips": 0.1}}}}
    assert methods_table(metrics).best == {(1, 1)}


def test_alone_nothing_is_best():
    assert methods_table({"mean": MEAN}).best == frozenset()


def test_views_end_with_their_mean_and_may_show_their_input():
    views = [{"name": "03", **MEAN, "input": {"psnr": 20.0}}]
    table = views_table(views, MEAN, input_mean={"psnr": 20.0})
    assert table.columns == ("view", "PSNR (dB)", "SSIM", "SSIM (paper)", "input PSNR (dB)")
    assert [row[0] for row in table.rows] == ["03", "mean"]
    assert table.rows[0][-1] == "20.00"
    assert len(views_table(views, MEAN).columns) == 4


def test_metrics_of_depth_alignment_and_events_have_columns():
    mean = MEAN | {"psnr_aligned": 33.0, "depth_error": 0.0712, "event_psnr": 30.04}
    table = methods_table({"mean": mean})
    assert table.columns[-3:] == ("aligned PSNR (dB)", "depth error", "event PSNR (dB)")
    assert table.rows[0][-3:] == ("33.00", "0.0712", "30.04")
    assert {"event_f1", "none_psnr", "lpips"} <= reported_metrics().keys()
