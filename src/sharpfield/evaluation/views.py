"""What a model renders where a frame was taken, beside what it should look like."""

from dataclasses import dataclass
from time import perf_counter

import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.capture import Capture
from sharpfield.core.errors import RunError
from sharpfield.core.protocols import Model
from sharpfield.evaluation.brightness import Brightness, fit_brightness
from sharpfield.evaluation.device import device_of
from sharpfield.evaluation.reference import Reference
from sharpfield.geometry.rolling import Rolling, moved_rows
from sharpfield.rendering.view import CHUNK, Progress, render_view, renderer_of


@dataclass(frozen=True)
class View:
    """A render beside what it should look like."""

    reference: Reference
    light: Float[Tensor, "h w c"]
    """Linear, as the model gives it."""
    depth: Float[Tensor, "h w"]
    opacity: Float[Tensor, "h w"]
    seconds: float


def seen_at(
    model: Model,
    reference: Reference,
    capture: Capture,
    *,
    pose: Float[Tensor, "3 4"] | None = None,
    chunk: int = CHUNK,
    progress: Progress | None = None,
) -> View:
    """Render a model from the middle of a frame's exposure.

    Args:
        model: Trained, more or less.
        reference: Which frame.
        capture: What the frame belongs to; on the same clock as the model's own capture.
        pose: To render from instead of the capture's, in the model's space.
        chunk: Rays rendered at once.
        progress: Called with the number of pixels rendered, and the number of all.

    Raises:
        RunError: The model renders numbers that are not finite.
    """
    frames, own = capture.needed_frames, model.capture
    time = float(own.clock.unit(frames.exposure.middle_us)[reference.frame])
    home, track = device_of(own.trajectory), int(frames.track[reference.frame])
    when = torch.tensor(time, device=home), torch.tensor(track, device=home)
    shutter = Rolling.of(capture, along=own.trajectory)
    with torch.no_grad():
        start = shutter.pose(*when)
        here = (start if pose is None else pose).to(device_of(model))
        rows = moved_rows(shutter.rows(*when), start, here)
    begun = perf_counter()
    seen = render_view(
        renderer_of(model), own.camera, here, time, rows=rows, chunk=chunk, progress=progress
    )
    if not seen.rgb.isfinite().all():
        raise RunError(
            "the model renders colours that are not finite numbers",
            where=f"frame {reference.name}",
            got=f"{int((~seen.rgb.isfinite()).sum())} of {seen.rgb.numel()} values",
            do="train again, or evaluate an earlier checkpoint",
        )
    return View(reference, seen.rgb, seen.depth, seen.opacity, perf_counter() - begun)


def brightness_of(model: Model, views: list[View], *, blind: bool | None = None) -> Brightness:
    """As the model develops light; for a model of events alone, aligned to the references.

    Args:
        model: Trained, more or less.
        views: To align.
        blind: Whether the model knows no absolute brightness; None: if its capture has no frames.
    """
    home = device_of(model)

    @torch.no_grad()
    def develop(light: Tensor) -> Tensor:
        return model.develop(light.to(home)).cpu()

    events = model.capture.events
    blind = model.capture.frames is None if blind is None else blind
    compared = [
        (view.light, view.reference.image) for view in views if view.reference.image is not None
    ]
    if not blind or events is None:
        return Brightness(develop, grey=any(image.shape[-1] == 1 for _, image in compared))
    return fit_brightness(develop, compared, grey=not events.coloured)
