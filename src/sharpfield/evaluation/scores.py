"""The metrics of single views (`sharpfield.metrics`), and their means over views."""

import math
from collections.abc import Iterable, Mapping

from jaxtyping import Float
from torch import Tensor

from sharpfield.metrics.lpips import Lpips
from sharpfield.metrics.registry import METRICS, Metric, with_lpips

Scores = dict[str, float | None]


def view_metrics(lpips: Lpips | None = None) -> dict[str, Metric]:
    """All metrics of single views by name, those of installed packages too.

    Args:
        lpips: With its weights, if there are any; without them LPIPS cannot be computed.
    """
    found: dict[str, Metric] = METRICS.working()
    return found if lpips is None else found | {"lpips": with_lpips(lpips)}


def score(
    image: Float[Tensor, "h w c"],
    reference: Float[Tensor, "h w c"],
    metrics: Mapping[str, Metric],
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
