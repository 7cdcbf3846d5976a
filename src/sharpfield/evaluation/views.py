"""Renders of a model at the poses of frames, beside their reference images.

A *held-out* frame is compared with its sharp truth if the capture knows it, else with its own
image. That image is sharp when it was taken in one instant; when it was exposed for a while it is
blurred, and the reference says so, since a sharp render then gets a low score.

`validation` scores a model during training on a few held-out views.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import RunError
from sharpfield.core.frames import Frames
from sharpfield.core.protocols import Model
from sharpfield.core.seed import evenly_spread
from sharpfield.core.struct import device_of
from sharpfield.evaluation.brightness import Brightness, fit_brightness
from sharpfield.geometry.rolling import Rolling, moved_rows
from sharpfield.metrics.image import psnr
from sharpfield.rendering.view import CHUNK, Progress, render_view, renderer_of
from sharpfield.report.colormaps import as_display

TRUTH, SHARP, BLURRED = "truth", "sharp image", "blurred image"

UNSCORED = 3
"""Training views that are rendered for the report where no truth is known."""


@dataclass(frozen=True)
class Reference:
    """A frame, and the image that a render from its mid-exposure pose is compared with."""

    frame: int
    name: str
    kind: str
    """`truth`, `sharp image`, `blurred image`, or "" where there is nothing to compare with."""
    image: Float[Tensor, "h w c"] | None
    """Display domain, 0...1."""
    measured: Float[Tensor, "h w c"]
    """As recorded, display domain, 0...1."""


def held_out(capture: Capture) -> list[Reference]:
    """References of the frames that were not trained on, in the order of the split."""
    if capture.frames is None:
        return []
    return [_reference(capture.frames, int(i), own_image=True) for i in capture.split.test]


def trained_on(capture: Capture, *, limit: int | None = None) -> list[Reference]:
    """References of training frames whose sharp truth is known; if none is, a few without one.

    Args:
        capture: With or without frames.
        limit: Most frames to return, evenly spread; None for all.
    """
    frames = capture.frames
    if frames is None:
        return []
    chosen = capture.split.train[frames.with_truth[capture.split.train]]
    if len(chosen):
        chosen = evenly_spread(chosen, len(chosen) if limit is None else limit)
    else:
        chosen = evenly_spread(
            capture.split.train, UNSCORED if limit is None else min(limit, UNSCORED)
        )
    return [_reference(frames, int(i), own_image=False) for i in chosen]


def _reference(frames: Frames, i: int, *, own_image: bool) -> Reference:
    measured = as_display(frames.images[i])
    if frames.truth is not None and frames.with_truth[i]:
        return Reference(i, frames.names[i], TRUTH, as_display(frames.truth[i]), measured)
    if not own_image:
        return Reference(i, frames.names[i], "", None, measured)
    kind = SHARP if frames.exposure.instant[i] else BLURRED
    return Reference(i, frames.names[i], kind, measured, measured)


@dataclass(frozen=True)
class RenderedView:
    """A render beside its reference."""

    reference: Reference
    light: Float[Tensor, "h w c"]
    """Linear, as the model gives it."""
    depth: Float[Tensor, "h w"]
    opacity: Float[Tensor, "h w"]
    seconds: float


def render_reference(
    model: Model,
    reference: Reference,
    capture: Capture,
    *,
    pose: Float[Tensor, "3 4"] | None = None,
    chunk: int = CHUNK,
    progress: Progress | None = None,
) -> RenderedView:
    """Render a model from the middle of a frame's exposure.

    Args:
        model: Trained, or in training.
        reference: The frame.
        capture: What the frame belongs to; on the same clock as the model's own capture.
        pose: To render from instead of the capture's, in the model's space.
        chunk: Rays rendered at once.
        progress: Called with the number of pixels rendered, and the number of all.

    Raises:
        RunError: The model renders numbers that are not finite.
    """
    frames, own = capture.needed_frames, model.capture
    time = float(own.clock.unit(frames.exposure.middle_us)[reference.frame])
    device, track = device_of(own.trajectory), int(frames.track[reference.frame])
    at = torch.tensor(time, device=device), torch.tensor(track, device=device)
    shutter = Rolling.of(capture, along=own.trajectory)
    with torch.no_grad():
        own_pose = shutter.pose(*at)
        pose = (own_pose if pose is None else pose).to(device_of(model))
        rows = moved_rows(shutter.rows(*at), own_pose, pose)
    start = perf_counter()
    render = render_view(
        renderer_of(model), own.camera, pose, time, rows=rows, chunk=chunk, progress=progress
    )
    if not render.rgb.isfinite().all():
        raise RunError(
            "the model renders colours that are not finite numbers",
            where=f"frame {reference.name}",
            got=f"{int((~render.rgb.isfinite()).sum())} of {render.rgb.numel()} values",
            do="train again, or evaluate an earlier checkpoint",
        )
    seconds = perf_counter() - start
    return RenderedView(reference, render.rgb, render.depth, render.opacity, seconds)


def brightness_of(
    model: Model, views: list[RenderedView], *, blind: bool | None = None
) -> Brightness:
    """The tone curve of the model; for a model of events alone, aligned to the references.

    Args:
        model: Trained, or in training.
        views: To align.
        blind: Whether the model knows no absolute brightness; None: if its capture has no frames.
    """
    device = device_of(model)

    @torch.no_grad()
    def encode(light: Tensor) -> Tensor:
        return model.encode(light.to(device)).cpu()

    events = model.capture.events
    blind = model.capture.frames is None if blind is None else blind
    compared = [
        (view.light, view.reference.image) for view in views if view.reference.image is not None
    ]
    if not blind or events is None:
        return Brightness(encode, grey=any(image.shape[-1] == 1 for _, image in compared))
    return fit_brightness(encode, compared, grey=not events.coloured)


VIEWS = 2
"""Held-out views that are rendered."""


def validation(capture: Capture, *, views: int = VIEWS) -> Callable[[Model], float] | None:
    """A function that gives the mean PSNR of some held-out views, as `evaluate` measures it.

    Args:
        capture: As read, with its held-out frames.
        views: Number of views; the same ones every time, evenly spread.

    Returns:
        The function; None where there is no image to compare with.
    """
    known = [reference for reference in held_out(capture) if reference.image is not None]
    if not known:
        return None
    chosen = [known[i] for i in evenly_spread(np.arange(len(known)), views)]

    def mean_psnr(model: Model) -> float:
        rendered = [render_reference(model, reference, capture) for reference in chosen]
        brightness = brightness_of(model, rendered)
        scores = [
            psnr(brightness.image(view.light), brightness.reference(image))
            for view in rendered
            if (image := view.reference.image) is not None
        ]
        return float(sum(scores)) / len(scores)

    return mean_psnr
