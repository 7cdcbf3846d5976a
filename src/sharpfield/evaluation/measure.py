"""Evaluation of a trained model: renders against held-out images, and against sharp truth.

`RUN/metrics.json` states the protocol of each number; `RUN/renders/` holds the images. Images are
compared in the display domain, as the frames store them.

Views are rendered at the middle of the exposure of a frame, in the model's world. The capture that
is compared with may hold more than the model was trained on (frames, for a model trained on events
alone), as long as both have the same clock. The protocol holds everything that is needed to
reproduce the metrics.
"""

import json
import math
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy
import torch
from jaxtyping import Float
from torch import Tensor

import sharpfield
from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError, RunError
from sharpfield.core.files import write_json
from sharpfield.core.protocols import Model
from sharpfield.evaluation.brightness import Brightness
from sharpfield.evaluation.event_scores import score_events, write_event_videos
from sharpfield.evaluation.refine import training_pose_errors
from sharpfield.evaluation.scores import (
    DEPTH_ERROR,
    PSNR_ALIGNED,
    aligned_psnr,
    distances,
    mean,
    scaled_depth_error,
    score,
    view_metrics,
)
from sharpfield.evaluation.views import (
    Reference,
    RenderedView,
    brightness_of,
    held_out,
    render_reference,
    trained_on,
)
from sharpfield.metrics.image import laplacian_variance
from sharpfield.metrics.lpips import SMALLEST_PX, Lpips
from sharpfield.metrics.registry import Metric
from sharpfield.rendering.view import CHUNK, Progress, ViewRenderer, renderer_of
from sharpfield.report.colormaps import colour_depth, eight_bit
from sharpfield.storage.images import write_image

ENABLE_LPIPS = (
    "give torchvision's AlexNet weights (alexnet-owt-7be5be79.pth) and the linear layers of LPIPS"
    " v0.1 (alex.pth, part of the packages lpips and torchmetrics)"
)


def describe_protocol(
    capture: Capture, test: Sequence[Reference], lpips: Lpips | None, *, too_small: bool = False
) -> dict[str, Any]:
    """The part of the protocol that depends on the capture and on the definitions.

    `too_small` images for its network are why LPIPS is None.
    """
    frames = capture.frames
    return {
        "capture": capture.name,
        "layout": capture.source,
        "resolution": list(capture.camera.size),
        "encoding": frames.encoding if frames is not None else None,
        "split": {
            "train": len(capture.split.train),
            "test": len(capture.split.test),
            "test_frames": [reference.name for reference in test],
        },
        "references": dict(Counter(reference.kind for reference in test)),
        "why_no_scores": _why_no_scores(capture, test),
        "domain": "display (as stored), 0...1; renders clamped, not quantised",
        "averaging": "mean over views of the number of each view",
        # Metrics of events have their definitions beside their values.
        **{
            one.name: one.definition
            for one in (*view_metrics().values(), PSNR_ALIGNED, DEPTH_ERROR)
        },
        "lpips": _lpips(lpips, too_small),
        "pose_refinement": "none",
        "versions": {
            "sharpfield": sharpfield.__version__,
            "torch": torch.__version__,
            "numpy": numpy.__version__,
            "python": platform.python_version(),
        },
    }


def _why_no_scores(capture: Capture, test: Sequence[Reference]) -> str | None:
    if test:
        return None
    if capture.frames is None:
        return "the capture has no frames to compare with"
    return "the capture holds no frame out"


def _lpips(lpips: Lpips | None, too_small: bool) -> dict[str, Any]:
    if lpips is not None:
        return {"computed": True, "version": "0.1", "network": lpips.network, **lpips.sha256}
    if too_small:
        reason = f"images are smaller than the network allows ({SMALLEST_PX} px)"
        return {"computed": False, "reason": reason, "enable": "evaluate at a larger size"}
    return {"computed": False, "reason": "no weights were given", "enable": ENABLE_LPIPS}


METRICS = "metrics.json"

LEAST_OPACITY = 1e-3
"""Depth is divided by at least this opacity."""


@dataclass(frozen=True)
class EvaluationOptions:
    """What is rendered and compared, and how."""

    chunk: int = CHUNK
    """Rays rendered at once."""
    train_views: int | None = None
    """Most training views with known truth to render, evenly spread; None for all."""
    lpips: Lpips | None = None
    """LPIPS with its weights, if the user has them."""
    poses: Mapping[int, Float[Tensor, "3 4"]] = field(default_factory=dict)
    """Poses to render frames from instead of the capture's, in the model's space."""
    events_only: bool | None = None
    """Whether the model knows no absolute brightness; None: if its capture has no frames."""
    stated: Mapping[str, Any] = field(default_factory=dict)
    """Further entries of the protocol: pose refinement, near-plane removal, ..."""


def evaluate(
    model: Model,
    capture: Capture,
    run: Path,
    *,
    options: EvaluationOptions | None = None,
    baselines: Mapping[str, Mapping[str, Any]] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure a model on its held-out views and training views; write `metrics.json`.

    Args:
        model: Trained.
        capture: What to compare with; on the same clock as the model's own capture.
        run: Folder that gets `metrics.json` and `renders/`, and has `training.json`.
        options: Options.
        baselines: Metrics of other methods to keep beside ours, by name: `{"mean": {...}}`, and
            "run" with the folder of their renders, relative to `run`, for the report.
        progress: Called with the number of pixels rendered, and the number of all.

    Returns:
        What was written.

    Raises:
        OptionError: The capture's frames have another size than the model's.
        RunError: `training.json` is damaged, or the model renders numbers that are not finite.
    """
    options = options or EvaluationOptions()
    _expect_same_size(model, capture)
    test, train = held_out(capture), trained_on(capture, limit=options.train_views)
    total = _TotalProgress(progress, len(test) + len(train), model.capture.camera.size)
    test_views, train_views = (
        [
            render_reference(
                model,
                reference,
                capture,
                pose=options.poses.get(reference.frame),
                chunk=options.chunk,
                progress=total.within_view,
            )
            for reference in references
        ]
        for references in (test, train)
    )
    brightness = brightness_of(model, test_views or train_views, blind=options.events_only)
    lpips = options.lpips
    too_small = lpips is not None and min(capture.camera.size) < SMALLEST_PX[lpips.network]
    lpips = None if too_small else lpips
    known, renders = view_metrics(lpips), run / "renders"
    tested = [_row(view, brightness, known, renders / "test") for view in test_views]
    learned = [_row(view, brightness, known, renders / "train") for view in train_views]
    events = score_events(model, capture)
    metrics: dict[str, Any] = {
        "protocol": {
            **describe_protocol(capture, test, lpips, too_small=too_small),
            "alignment": brightness.stated(),
            "compared_as": "luma" if brightness.grey else "all channels",
            **options.stated,
        },
        "mean": mean((row for row in tested if row["reference"]), known)
        | _capture_metrics(model, capture, test_views, brightness, events),
        "views": tested,
        "train_views": _train_summary(learned, train_views, brightness, known),
        "train": _training(run),
    }
    if events is not None:
        metrics["events"] = {**events, "videos": write_event_videos(model, capture, run)}
    if (errors := training_pose_errors(model, capture)) is not None:
        metrics["poses"] = errors
    if baselines:
        metrics["baselines"] = {name: dict(values) for name, values in baselines.items()}
    write_json(run / METRICS, metrics, allow_nan=False)
    return metrics


class _TotalProgress:
    """Progress over several views."""

    def __init__(self, progress: Progress | None, views: int, size: tuple[int, int]) -> None:
        self.progress, self.pixels = progress, size[0] * size[1]
        self.total, self.before = views * self.pixels, 0

    def within_view(self, done: int, _: int) -> None:
        """Called by the renderer of one view."""
        if self.progress is not None:
            self.progress(self.before + done, self.total)
        self.before += self.pixels if done == self.pixels else 0


def _row(
    view: RenderedView, brightness: Brightness, metrics: Mapping[str, Metric], folder: Path
) -> dict[str, Any]:
    """Write the images of a view; returns its row of `metrics.json`."""
    reference = view.reference
    image = brightness.image(view.light)
    name = f"{reference.frame:04d}"
    write_image(folder / f"{name}.png", eight_bit(image.numpy()))
    write_image(folder / f"{name}_depth.png", colour_depth(view.depth.numpy()))
    row: dict[str, Any] = {
        "name": reference.name,
        "frame": reference.frame,
        "reference": reference.kind or None,
    }
    if reference.image is None:
        row |= dict.fromkeys(metrics)
    else:
        row |= score(image, brightness.reference(reference.image), metrics)
    return row | {
        "seconds": round(view.seconds, 3),
        "image": f"renders/{folder.name}/{name}.png",
        "depth": f"renders/{folder.name}/{name}_depth.png",
    }


def _capture_metrics(
    model: Model,
    capture: Capture,
    views: list[RenderedView],
    brightness: Brightness,
    events: Mapping[str, Any] | None,
) -> dict[str, float]:
    """Metrics that need events or depth of the capture, over all held-out views."""
    found: dict[str, float] = {}
    if events is not None:
        longest = events["lengths"][max(events["lengths"], key=float)]
        found |= {name: longest[name] for name in ("event_psnr", "event_mae")}
    pairs = [(view.light, image) for view in views if (image := view.reference.image) is not None]
    if pairs and capture.events is not None:
        found[PSNR_ALIGNED.name] = math.fsum(
            aligned_psnr(brightness.image(light), brightness.reference(image))
            for light, image in pairs
        ) / len(pairs)
    frames = capture.frames
    if frames is not None and frames.depth is not None and views:
        whole_views = isinstance(renderer_of(model), ViewRenderer)
        truth = [frames.depth[view.reference.frame] for view in views]
        if not whole_views:  # the depth of rays is a distance, weighted by opacity
            truth = [distances(one, capture.camera) for one in truth]
        rendered = [
            view.depth if whole_views else view.depth / view.opacity.clamp_min(LEAST_OPACITY)
            for view in views
        ]
        error = scaled_depth_error(rendered, [view.opacity for view in views], truth)
        if error is not None:
            found[DEPTH_ERROR.name] = error
    return found


def _train_summary(
    rows: list[dict[str, Any]],
    views: list[RenderedView],
    brightness: Brightness,
    metrics: Mapping[str, Metric],
) -> dict[str, Any]:
    """Means over training views with known truth, and how their blurred input scores there."""
    inputs = []
    for row, view in zip(rows, views, strict=True):
        measured, truth = view.reference.measured, view.reference.image
        measured = brightness.reference(measured)
        row["sharpness"] = {
            "result": float(laplacian_variance(brightness.image(view.light))),
            "input": float(laplacian_variance(measured)),
        }
        if truth is not None:
            truth = brightness.reference(truth)
            row["sharpness"]["truth"] = float(laplacian_variance(truth))
            row["input"] = score(measured, truth, metrics)
            inputs.append(row["input"])
    return {
        "count": len(inputs),
        "mean": mean((row for row in rows if row["reference"]), metrics),
        "input": {"mean": mean(inputs, metrics)},
        "views": rows,
    }


def _training(run: Path) -> dict[str, Any]:
    """The cost of training, from `training.json`."""
    path = run / "training.json"
    cost: dict[str, Any] = dict.fromkeys(("steps", "seconds", "peak_memory_mb"))
    if not path.is_file():
        return cost
    try:
        written = json.loads(path.read_text())
        return {name: written.get(name) for name in cost}
    except (ValueError, AttributeError) as error:
        raise RunError("cannot be read", where=path, got=error, do="train again") from None


def _expect_same_size(model: Model, capture: Capture) -> None:
    if capture.frames is not None and capture.camera.size != model.capture.camera.size:
        raise OptionError(
            "the model was trained at another image size",
            where=capture.name,
            got=f"frames {capture.camera.size}, model {model.capture.camera.size}",
            do="evaluate on the capture it was trained on",
        )
