"""The metrics of single views (`sharpfield.metrics`), and their means over views.

Metrics of all held-out views together: PSNR after aligning brightness, error of depth.

Source: EvDNeRF (WACV 2024) for the alignment of single images, which is EventNeRF's (CVPR 2023)
formula.

Tables of metrics: methods side by side, and the views of one run.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from torch import Tensor

from sharpfield.core.camera import Camera
from sharpfield.core.tone import luma
from sharpfield.evaluation.event_scores import EVENT_METRICS
from sharpfield.metrics.image import psnr
from sharpfield.metrics.lpips import Lpips
from sharpfield.metrics.registry import HIGHEST_PSNR, METRICS, Metric, with_lpips
from sharpfield.report.page import TextTable

Scores = dict[str, float | None]


def view_metrics(lpips: Lpips | None = None) -> dict[str, Metric]:
    """All metrics of single views by name, those of installed packages too.

    Args:
        lpips: With its weights, if there are any; without them LPIPS cannot be computed.
    """
    found: dict[str, Metric] = METRICS.working()
    return found if lpips is None else found | {"lpips": with_lpips(lpips)}


def score(
    image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"], metrics: Mapping[str, Metric]
) -> Scores:
    """Metrics of one image, display domain, 0...1; None for LPIPS without weights."""
    return {
        name: None if metric.compute is None else float(metric.compute(image, reference))
        for name, metric in metrics.items()
    }


def mean(scores: Iterable[Mapping[str, float | None]], metrics: Iterable[str]) -> Scores:
    """Mean of each metric over views; None where a view lacks it, or without views."""
    scores = list(scores)
    found: Scores = {}
    for name in metrics:
        values = [value for one in scores if (value := one[name]) is not None]
        complete = len(values) == len(scores) > 0
        found[name] = math.fsum(values) / len(values) if complete else None
    return found


DARK = 0.1
"""Added to display values before the logarithm (published)."""

OPAQUE = 0.5
"""Opacity from which a rendered pixel counts as having a depth."""

TINY = 1e-9

PSNR_ALIGNED = Metric(
    "psnr_aligned",
    "aligned PSNR (dB)",
    "psnr of the luma, once log(0.1 + luma) of each image is fitted to that of its reference by a"
    " gain and an offset (as published)",
    "higher",
    "{:.2f}",
)
"""Computed where the capture has events, by `aligned_psnr` for each view."""

DEPTH_ERROR = Metric(
    "depth_error",
    "depth error",
    "mean relative error of the depth of each view, at most 1 a pixel, where the truth has one,"
    " after a common scale (the ratio of the medians of all views); what is less than half opaque"
    " counts 1",
    "lower",
    "{:.4f}",
)
"""Computed where the capture has true depth, by `scaled_depth_error` for all views at once."""


def aligned_psnr(image: Float[Tensor, "h w c"], reference: Float[Tensor, "h w c"]) -> float:
    """PSNR after fitting the brightness of an image to that of its reference, both 0...1."""
    target, log_luma = ((luma(one).double() + DARK).log() for one in (reference, image))
    variance = log_luma.var(correction=0).clamp_min(TINY)
    gain = ((target * log_luma).mean() - target.mean() * log_luma.mean()) / variance
    fitted = (gain * (log_luma - log_luma.mean()) + target.mean()).exp() - DARK  # [h, w]
    found = psnr(fitted.clamp(0, 1)[..., None].float(), luma(reference)[..., None].float())
    return min(float(found), HIGHEST_PSNR)


def scaled_depth_error(
    rendered: Sequence[Float[Tensor, "h w"]],
    opacity: Sequence[Float[Tensor, "h w"]],
    truth: Sequence[Float32[np.ndarray, "h w"]],
) -> float | None:
    """Mean relative error of depth after a common scale; None where no truth is finite.

    Args:
        rendered: Distances of each view, in any unit.
        opacity: Of the same pixels.
        truth: Distances; infinite or zero where there is nothing.
    """
    known = [np.isfinite(one) & (one > 0) for one in truth]
    opaque = [one.numpy() >= OPAQUE for one in opacity]
    both = [k & o for k, o in zip(known, opaque, strict=True)]
    if not any(k.any() for k in known):
        return None
    if not any(b.any() for b in both):
        return 1.0
    found = [one.double().numpy() for one in rendered]
    medians = [
        np.median(np.concatenate([one[b] for one, b in zip(maps, both, strict=True)]))
        for maps in (found, truth)
    ]
    scale = medians[1] / max(medians[0], TINY)
    errors = []
    for found_one, true_one, known_one, both_one in zip(found, truth, known, both, strict=True):
        if not known_one.any():
            continue
        relative = np.abs(scale * found_one - true_one) / np.where(known_one, true_one, 1)
        error = np.where(both_one, np.minimum(relative, 1), 1)  # [h, w]
        errors.append(float(error[known_one].mean()))
    return math.fsum(errors) / len(errors)


def distances(depth: Float32[np.ndarray, "h w"], camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Depth along the optical axis as distance along the ray of each pixel."""
    toward = camera.direction(camera.grid().double())
    return (depth / toward[..., 2].numpy()).astype(np.float32)


OURS = "this run"


def reported_metrics() -> dict[str, Metric]:
    """The metrics that a mean over held-out views may have, in the order of the columns."""
    others = (PSNR_ALIGNED, DEPTH_ERROR, *EVENT_METRICS)
    return view_metrics() | {metric.name: metric for metric in others}


def methods_table(metrics: Mapping[str, Any]) -> TextTable:
    """Means over held-out views of this run and its baselines; the best of each column marked."""
    means = {OURS: metrics["mean"]}
    means |= {name: other["mean"] for name, other in metrics.get("baselines", {}).items()}
    columns = _present(reported_metrics(), list(means.values()))
    rows = tuple(
        (name, *(metric.text(mean.get(metric.name)) for metric in columns))
        for name, mean in means.items()
    )
    titles = ("method", *(metric.title for metric in columns))
    return TextTable(titles, rows, _best(list(means.values()), columns))


def views_table(
    views: Sequence[Mapping[str, Any]],
    mean: Mapping[str, Any],
    *,
    input_mean: Mapping[str, Any] | None = None,
) -> TextTable:
    """One row per view, and their mean.

    Args:
        views: Rows of `metrics.json`.
        mean: Their mean.
        input_mean: Mean over their blurry inputs, to show the inputs' PSNR as well.
    """
    with_input = input_mean is not None
    known = view_metrics()
    columns = _present(known, views)
    titles = ["view", *(metric.title for metric in columns)]
    titles += [f"input {known['psnr'].title}"] * with_input
    rows = []
    for view in [*views, {"name": "mean", **mean, "input": input_mean or {}}]:
        row = [str(view["name"]), *(metric.text(view.get(metric.name)) for metric in columns)]
        rows.append((*row, *[known["psnr"].text(view.get("input", {}).get("psnr"))] * with_input))
    return TextTable(tuple(titles), tuple(rows))


def _present(known: Mapping[str, Metric], scores: Sequence[Mapping[str, Any]]) -> list[Metric]:
    """The metrics that any row has."""
    return [
        metric
        for metric in known.values()
        if any(row.get(metric.name) is not None for row in scores)
    ]


def _best(
    means: Sequence[Mapping[str, Any]], columns: Sequence[Metric]
) -> frozenset[tuple[int, int]]:
    if len(means) < 2:
        return frozenset()
    found = set()
    for column, metric in enumerate(columns, 1):
        values = [value for mean in means if (value := mean.get(metric.name)) is not None]
        best = metric.best(values)
        row = next(i for i, mean in enumerate(means) if mean.get(metric.name) == best)
        found.add((row, column))
    return frozenset(found)
