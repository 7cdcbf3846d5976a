"""Metrics of event frames of held-out cameras: predicted against recorded changes.

An *event frame* holds, for each pixel, the change of log intensity in a time window: predicted by a
model, or the signed count of events times their thresholds. Each window belongs to one camera. All
metrics are means over event frames.

A video shows one window after the other, recorded on the left, predicted on the right, in one
scale. The prediction is the published one: the change of log light over a window in whole
thresholds. (The `events` command renders event streams instead.)

Source: EvDNeRF (WACV 2024), its figures and videos, and its released evaluation for PSNR, SSIM and
MAE of event frames.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.protocols import Model
from sharpfield.core.struct import device_of
from sharpfield.core.tone import luma
from sharpfield.events.image import window_image
from sharpfield.events.index import EventIndex
from sharpfield.events.threshold import thresholds_of
from sharpfield.formation.response import FLOOR
from sharpfield.metrics.image import ssim
from sharpfield.metrics.registry import Metric
from sharpfield.rendering.view import render_view, renderer_of
from sharpfield.report.colormaps import Rgb, colour_signs, side_by_side
from sharpfield.report.event_frames import full_count
from sharpfield.report.page import TextTable
from sharpfield.report.video import write_video
from sharpfield.storage.event_cache import event_index

WINDOWS = 8
"""Windows of each camera, evenly spread."""
LENGTHS = (1 / 32, 1 / 128)
"""Lengths of the windows as shares of the capture: the longest of the paper's, and the shortest."""
MOST_COUNT = 20.0
"""Counts are clipped to this where the range of a metric is fixed."""


@dataclass(frozen=True)
class EventFrame:
    """The change of log intensity in one window: predicted, and recorded."""

    change: Float[Tensor, "h w"]
    """Predicted; natural log."""
    counts: Float[Tensor, "2 h w"]
    """Recorded events, to darker and to brighter."""
    thresholds: tuple[float, float]
    """Contrast thresholds, to darker and to brighter."""
    largest: float
    """Largest recorded change of all windows of this length."""

    @property
    def recorded(self) -> Float[Tensor, "h w"]:
        """Recorded change: events times their thresholds."""
        off, on = self.thresholds
        return on * self.counts[1] - off * self.counts[0]

    @property
    def net_count(self) -> Float[Tensor, "h w"]:
        """Recorded events, brighter minus darker."""
        return self.counts[1] - self.counts[0]

    @property
    def predicted_count(self) -> Float[Tensor, "h w"]:
        """Predicted change in mean thresholds."""
        return self.change / (sum(self.thresholds) / 2)

    @property
    def active(self) -> Bool[Tensor, "h w"]:
        """Pixels where an event was recorded."""
        return self.counts.sum(0) > 0

    def image(self, change: Float[Tensor, "h w"]) -> Float[Tensor, "h w 1"]:
        """A change mapped from -largest...largest to 0...1."""
        return ((change / self.largest).clamp(-1, 1) / 2 + 0.5)[..., None]


def _event_psnr(frame: EventFrame, change: Tensor) -> float:
    return _psnr(change, frame.recorded, 2 * frame.largest)


def _count_psnr(frame: EventFrame, count: Tensor) -> float:
    count, recorded = (one.clamp(-MOST_COUNT, MOST_COUNT) for one in (count, frame.net_count))
    return _psnr(count, recorded, 2 * MOST_COUNT)


def _count_mae(frame: EventFrame, where: Tensor) -> float:
    error = (frame.predicted_count - frame.net_count).abs()
    return float(error[where].mean()) if where.any() else 0.0


def _metric(
    name: str, title: str, definition: str, better: Literal["higher", "lower"] = "higher"
) -> Metric:
    return Metric(name, title, definition, better, "{:.4g}")


EVENT_METRICS: dict[Metric, Callable[[EventFrame], float]] = {
    _metric(
        "event_psnr",
        "event PSNR (dB)",
        "dB; peak is twice the largest recorded change of all windows (as published)",
    ): lambda frame: _event_psnr(frame, frame.change),
    _metric(
        "event_mae", "event MAE", "mean absolute difference, natural log", "lower"
    ): lambda frame: float((frame.change - frame.recorded).abs().mean()),
    _metric(
        "event_ssim",
        "event SSIM",
        "on event frames mapped from -M...M to 0...1, M the largest recorded change",
    ): lambda frame: float(ssim(frame.image(frame.change), frame.image(frame.recorded))),
    _metric(
        "count_psnr",
        "PSNR of counts (dB)",
        f"dB, in events, peak {2 * MOST_COUNT:g}, both clipped to +-{MOST_COUNT:g}",
    ): lambda frame: _count_psnr(frame, frame.predicted_count),
    _metric(
        "count_mae_busy",
        "MAE of counts, active pixels",
        "mean absolute difference in events, where any were recorded",
        "lower",
    ): lambda frame: _count_mae(frame, frame.active),
    _metric(
        "count_mae_silent", "MAE of counts, silent pixels", "the same where none were", "lower"
    ): lambda frame: _count_mae(frame, ~frame.active),
    _metric(
        "event_f1",
        "F1 of active pixels",
        "of pixels with at least one event; predictions are rounded towards zero",
    ): lambda frame: _f1(frame.predicted_count.trunc() != 0, frame.net_count != 0),
    _metric(
        "none_psnr", "event PSNR of no events", "event_psnr of predicting nothing"
    ): lambda frame: _event_psnr(frame, 0 * frame.change),
    _metric(
        "none_count_psnr", "PSNR of counts of no events", "count_psnr of predicting nothing"
    ): lambda frame: _count_psnr(frame, 0 * frame.net_count),
}
"""Metrics of one event frame."""


@runtime_checkable
class HasLogLight(Protocol):
    """A model that states how its event camera responds to light."""

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """Log intensity (natural log, up to a constant) that the photoreceptors report."""
        ...


def score_events(
    model: Model, capture: Capture, *, windows: int = WINDOWS, lengths: Sequence[float] = LENGTHS
) -> dict[str, Any] | None:
    """Metrics for each window length; None if the capture holds out no event camera.

    Args:
        model: Trained.
        capture: On the same clock as the model's own.
        windows: Windows of each camera.
        lengths: Shares of the capture; windows of all lengths start at the same times.
    """
    if capture.test_events is None or not len(capture.test_events):
        return None
    index = event_index(capture.test_events)
    pairs: dict[float, list[tuple[Tensor, Tensor]]] = {length: [] for length in lengths}
    for track in np.unique(np.asarray(capture.test_events.track)).tolist():
        for start in (np.arange(windows) + 0.5) / windows * (1 - max(lengths)):
            first = render_log_intensity(model, int(track), float(start))
            for length in lengths:
                change = render_log_intensity(model, int(track), float(start + length)) - first
                counts = count_recorded(capture, index, int(track), (start, start + length))
                pairs[length].append((change, counts))
    return {
        "definitions": {metric.name: metric.definition for metric in EVENT_METRICS},
        "lengths": {f"{length:.5g}": _scores(pairs[length], capture) for length in lengths},
    }


def render_log_intensity(model: Model, track: int, time: float) -> Float[Tensor, "h w"]:
    """Log intensity that a camera sees at a time, as the response of the model gives it.

    A model without a response of its own gets the logarithm of luma above the floor of `formation`.
    """
    own = model.capture
    device = device_of(own.trajectory)
    pose = own.trajectory.pose(
        torch.tensor(time, device=device), torch.tensor(track, device=device)
    )
    pose = pose.detach().to(device_of(model))
    light = render_view(renderer_of(model), own.camera, pose, time).rgb
    if isinstance(model, HasLogLight):
        return model.log_light(light.to(device_of(model))).detach().cpu()
    return (luma(light) + FLOOR).log()


def count_recorded(
    capture: Capture, index: EventIndex, track: int, window: tuple[float, float]
) -> Float[Tensor, "2 h w"]:
    """Number of events to darker and to brighter at each pixel."""
    start_us, end_us = (int(capture.clock.us(t)) + 1 for t in window)
    camera = capture.camera
    counts = window_image(
        index, start_us, end_us, width=camera.width, height=camera.height, track=track
    )
    return torch.from_numpy(counts).permute(2, 0, 1).float()


def mean_threshold(capture: Capture) -> float:
    """Mean of the thresholds to darker and to brighter."""
    return sum(thresholds_of(capture)) / 2


def _scores(pairs: Sequence[tuple[Tensor, Tensor]], capture: Capture) -> dict[str, float]:
    """Means over event frames, each a predicted change `[h w]` and recorded counts `[2 h w]`."""
    off, on = thresholds_of(capture)
    recorded = torch.stack([on * counts[1] - off * counts[0] for _, counts in pairs])  # [n, h, w]
    largest = max(float(recorded.abs().max()), mean_threshold(capture))
    frames = [EventFrame(change, counts, (off, on), largest) for change, counts in pairs]
    return {
        metric.name: math.fsum(compute(frame) for frame in frames) / len(frames)
        for metric, compute in EVENT_METRICS.items()
    }


def _psnr(predicted: Tensor, measured: Tensor, peak: float) -> float:
    error = float((predicted - measured).square().mean())
    return 10 * math.log10(peak**2 / max(error, 1e-10 * peak**2))


def _f1(predicted: Tensor, recorded: Tensor) -> float:
    """Harmonic mean of precision and recall; 1 where nothing is recorded and nothing predicted."""
    both = int((predicted & recorded).sum())
    total = int(predicted.sum()) + int(recorded.sum())
    return 2 * both / total if total else 1.0


CAMERAS = 2
"""Most cameras with a video, evenly spread over those held out."""
VIDEO_WINDOWS = 20
"""Windows of a video; together they cover the capture."""
FPS = 8.0
"""Windows per second of the video."""
HEIGHT_PX = 240
"""Smaller images are enlarged by a whole factor up to this height."""
GAP_PX = 4
"""Gap between the two images."""


def write_event_videos(model: Model, capture: Capture, run: Path) -> list[dict[str, Any]]:
    """Write videos of some held-out event cameras to `run/renders/events/`.

    Returns:
        The number of each camera, and where its video is.
    """
    held_out = capture.test_events
    if held_out is None or not len(held_out):
        return []
    tracks = np.unique(np.asarray(held_out.track)) if held_out.track is not None else np.zeros(1)
    chosen = tracks[np.linspace(0, len(tracks) - 1, min(CAMERAS, len(tracks))).astype(int)]
    found = []
    for track in chosen.astype(int).tolist():
        path = Path("renders") / "events" / f"{track:02d}.mp4"
        (run / path).parent.mkdir(parents=True, exist_ok=True)
        write_video(run / path, _images(model, capture, track), fps=FPS)
        found.append({"track": track, "video": path.as_posix()})
    return found


def events_section(run: Path, metrics: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the page shows of held-out event cameras; None if there are none."""
    events = metrics.get("events")
    if events is None:
        return None
    known = [metric for metric in EVENT_METRICS if metric.name in events["definitions"]]
    rows = tuple(
        (
            f"1/{1 / float(length):.0f} of the capture",
            *(metric.text(scores.get(metric.name)) for metric in known),
        )
        for length, scores in events["lengths"].items()
    )
    return {
        "videos": [
            (one["track"], (run / one["video"]).read_bytes())
            for one in events.get("videos", [])
            if (run / one["video"]).is_file()
        ],
        "table": TextTable(("windows", *(metric.title for metric in known)), rows),
        "definitions": events["definitions"],
    }


def _images(model: Model, capture: Capture, track: int) -> list[Rgb]:
    """Recorded and predicted event frame of each window side by side."""
    assert capture.test_events is not None
    index = event_index(capture.test_events)
    ends = np.linspace(0, 1, VIDEO_WINDOWS + 1)
    log_images = [render_log_intensity(model, track, float(time)) for time in ends]
    predicted = [
        ((after - before) / mean_threshold(capture)).trunc().numpy()
        for before, after in zip(log_images, log_images[1:], strict=False)
    ]
    counts = [
        count_recorded(capture, index, track, (float(a), float(b))).numpy()
        for a, b in zip(ends, ends[1:], strict=False)
    ]
    recorded = [brighter - darker for darker, brighter in counts]
    full = full_count(np.stack(recorded).astype(np.int32))
    factor = max(HEIGHT_PX // capture.camera.height, 1)
    columns = [
        [np.kron(colour_signs(one, full), np.ones((factor, factor, 1), np.uint8)) for one in frames]
        for frames in (recorded, predicted)
    ]
    return [side_by_side(*pair, gap_px=GAP_PX, grey=128) for pair in zip(*columns, strict=True)]
