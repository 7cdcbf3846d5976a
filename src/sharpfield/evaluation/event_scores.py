"""Event frames of held-out cameras: predicted changes of light, and recorded ones.

An *event frame* holds, for each pixel, the change of log intensity in a window of time: as a model
predicts it, or as the signed count of events times their thresholds. Windows never reach from one
camera to another. All numbers are means over event frames.

Source: EvDNeRF (WACV 2024) and its released evaluation for PSNR, SSIM and MAE of event frames.
"""

import math
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.device import device_of
from sharpfield.core.protocols import Model
from sharpfield.core.tone import luma
from sharpfield.events.image import window_image
from sharpfield.events.index import EventIndex
from sharpfield.events.threshold import thresholds_of
from sharpfield.metrics.image import ssim
from sharpfield.rendering.view import render_view, renderer_of
from sharpfield.storage.event_cache import event_index

WINDOWS = 8
"""Windows of each camera, evenly spread."""
LENGTHS = (1 / 32, 1 / 128)
"""Of the windows, in shares of the capture: the longest of the paper's, and the shortest."""
FLOOR = 1e-5
"""Light added before the logarithm, for models that do not say what their event camera sees."""
MOST = 20.0
"""Counts beyond this are taken as this where the range of a measure is fixed."""

DEFINITIONS = {
    "event_psnr": "dB; peak is twice the largest recorded change of all windows (as published)",
    "event_mae": "mean absolute difference, natural log",
    "event_ssim": "on event frames mapped from -M...M to 0...1, M the largest recorded change",
    "count_psnr": f"dB, in events, peak {2 * MOST:g}, both clipped to +-{MOST:g}",
    "count_mae_busy": "mean absolute difference in events, where any were recorded",
    "count_mae_silent": "the same where none were",
    "event_f1": "of pixels with at least one event; predictions are rounded towards zero",
    "none_psnr": "event_psnr of predicting nothing",
    "none_count_psnr": "count_psnr of predicting nothing",
}

Scores = dict[str, float]


@runtime_checkable
class SeesEvents(Protocol):
    """A model that says what its event camera makes of light."""

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """Natural log of what a pixel's photoreceptor reports, up to a constant."""
        ...


def event_scores(
    model: Model,
    capture: Capture,
    *,
    windows: int = WINDOWS,
    lengths: Sequence[float] = LENGTHS,
) -> dict[str, Any] | None:
    """Scores of each length of window; None if the capture holds no event camera out.

    Args:
        model: Trained.
        capture: On the same clock as the model's own.
        windows: How many of each camera.
        lengths: In shares of the capture; windows of all lengths begin at the same times.
    """
    if capture.test_events is None or not len(capture.test_events):
        return None
    index = event_index(capture.test_events)
    pairs: dict[float, list[tuple[Tensor, Tensor]]] = {length: [] for length in lengths}
    for track in np.unique(np.asarray(capture.test_events.track)).tolist():
        for start in (np.arange(windows) + 0.5) / windows * (1 - max(lengths)):
            first = log_view(model, int(track), float(start))
            for length in lengths:
                change = log_view(model, int(track), float(start + length)) - first
                counted = recorded_counts(capture, index, int(track), (start, start + length))
                pairs[length].append((change, counted))
    return {
        "definitions": DEFINITIONS,
        "lengths": {f"{length:.5g}": _scores(pairs[length], capture) for length in lengths},
    }


def log_view(model: Model, track: int, time: float) -> Float[Tensor, "h w"]:
    """Log intensity that a camera sees at a time."""
    own = model.capture
    home = device_of(own.trajectory)
    pose = own.trajectory.pose(torch.tensor(time, device=home), torch.tensor(track, device=home))
    pose = pose.detach().to(device_of(model))
    seen = render_view(renderer_of(model), own.camera, pose, time).rgb
    if isinstance(model, SeesEvents):
        return model.log_light(seen.to(device_of(model))).detach().cpu()
    return (luma(seen) + FLOOR).log()


def recorded_counts(
    capture: Capture, index: EventIndex, track: int, window: tuple[float, float]
) -> Float[Tensor, "2 h w"]:
    """How many events to darker and to brighter each pixel reported."""
    start_us, end_us = (int(capture.clock.us(t)) + 1 for t in window)
    camera = capture.camera
    counts = window_image(
        index, start_us, end_us, width=camera.width, height=camera.height, track=track
    )
    return torch.from_numpy(counts).permute(2, 0, 1).float()


def usual_threshold(capture: Capture) -> float:
    """Mean of the thresholds to darker and to brighter."""
    return sum(thresholds_of(capture)) / 2


def _scores(pairs: Sequence[tuple[Tensor, Tensor]], capture: Capture) -> Scores:
    """Means over event frames."""
    off, on = thresholds_of(capture)
    usual = usual_threshold(capture)
    recorded = [on * counts[1] - off * counts[0] for _, counts in pairs]
    most = max(float(torch.stack(recorded).abs().max()), usual)
    rows: list[Scores] = []
    for (change, counts), measured in zip(pairs, recorded, strict=True):
        net, predicted = counts[1] - counts[0], change / usual
        busy = counts.sum(0) > 0
        rows.append(
            {
                "event_psnr": _psnr(change, measured, 2 * most),
                "event_mae": float((change - measured).abs().mean()),
                "event_ssim": float(ssim(*(_as_image(x, most) for x in (change, measured)))),
                "count_psnr": _psnr(predicted.clamp(-MOST, MOST), net.clamp(-MOST, MOST), 2 * MOST),
                "count_mae_busy": _mean_where((predicted - net).abs(), busy),
                "count_mae_silent": _mean_where((predicted - net).abs(), ~busy),
                "event_f1": _f1(predicted.trunc() != 0, net != 0),
                "none_psnr": _psnr(0 * measured, measured, 2 * most),
                "none_count_psnr": _psnr(0 * net, net.clamp(-MOST, MOST), 2 * MOST),
            }
        )
    return {name: math.fsum(row[name] for row in rows) / len(rows) for name in rows[0]}


def _psnr(predicted: Tensor, measured: Tensor, peak: float) -> float:
    error = float((predicted - measured).square().mean())
    return 10 * math.log10(peak**2 / max(error, 1e-10 * peak**2))


def _as_image(change: Tensor, most: float) -> Float[Tensor, "h w 1"]:
    return ((change / most).clamp(-1, 1) / 2 + 0.5)[..., None]


def _mean_where(value: Tensor, where: Tensor) -> float:
    return float(value[where].mean()) if where.any() else 0.0


def _f1(found: Tensor, wanted: Tensor) -> float:
    """Harmonic mean of precision and recall; 1 if there is nothing to find and nothing found."""
    both = int((found & wanted).sum())
    every = int(found.sum()) + int(wanted.sum())
    return 2 * both / every if every else 1.0
