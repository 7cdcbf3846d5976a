"""Tables of metrics: methods side by side, and the views of one run."""

from collections.abc import Mapping, Sequence
from typing import Any

from sharpfield.evaluation.alignment_and_depth import DEPTH_ERROR, PSNR_ALIGNED
from sharpfield.evaluation.event_scores import EVENT_METRICS
from sharpfield.evaluation.scores import view_metrics
from sharpfield.metrics.registry import Metric
from sharpfield.report.tables import TextTable

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
