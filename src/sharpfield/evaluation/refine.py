"""Refining the poses of held-out views on a finished model, before measuring it.

Where training poses were estimated or refined, the space of the model is not quite the space of
the held-out poses, and a shift of a pixel costs more PSNR than any blur. So the held-out poses are
first brought to the model's space by a similarity (`aligned_poses`) and then each is improved by
gradient descent on the difference between render and image, with the model frozen
(`refine_poses`).

The pose of each view is the one with the best PSNR on the very image that is then measured, which
is optimistic by construction; the protocol says so.

Source: BAD-NeRF (CVPR 2023) for the idea; numbers as in the authors' successor of Ev-DeblurNeRF
(IEEE T-RO 2026). That one also leaves out the removal of near floaters while it refines; here the
model renders as it always does.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.protocols import Model
from sharpfield.core.seed import numpy_generator
from sharpfield.core.struct import device_of
from sharpfield.evaluation.options import Refinement
from sharpfield.evaluation.views import held_out
from sharpfield.geometry import se3
from sharpfield.geometry.rays import cast
from sharpfield.geometry.rolling import Rolling, moved_rows
from sharpfield.metrics.image import psnr
from sharpfield.metrics.pose import absolute_error, align, relative_error
from sharpfield.rendering.splat import whole
from sharpfield.rendering.view import ViewRenderer, render_view, renderer_of

Pose = Float[Tensor, "3 4"]

COLLINEAR = 1e-3
"""Camera centres whose second singular value is below this part of the first lie on a line, which
leaves a similarity free to rotate about it."""

RMSPROP_SHARE = 0.67
"""Share of the steps done by RMSprop; Adam does the rest."""

MOVED_SHARE, MOVED_DEG = 1e-4, 0.01
"""Poses count as refined from this change on: of the spread of the cameras, or in degrees."""


@dataclass(frozen=True)
class Refined:
    """Refined poses of the held-out frames in the model's space, and the PSNR they gained."""

    poses: dict[int, Pose]
    """By frame; on the CPU."""
    before: dict[int, float]
    """PSNR (dB) of each frame at the start; empty without full renders."""
    after: dict[int, float]
    """PSNR at the chosen pose."""
    protocol: dict[str, Any]
    """Entries of the protocol for numbers measured at these poses."""


@dataclass(frozen=True)
class _View:
    """A held-out view and where its refinement starts."""

    frame: int
    start: Pose
    time: float
    rows: Float[Tensor, "q 3 4"] | None
    """At the start, with a rolling shutter."""
    image: Float[Tensor, "h w c"]


@dataclass(frozen=True)
class _Render:
    """The error of a full render of a view at some pose."""

    twist: Float[Tensor, "6"]
    psnr: float
    error: Float[Tensor, "p"]
    """Squared error of each pixel."""


def aligned_poses(model: Model, capture: Capture) -> dict[int, Pose]:
    """Poses of the held-out frames in the model's space, aligned by the training frames.

    The model's capture may have refined poses, or another space altogether. Where fewer than three
    training cameras, or cameras on one line, do not determine a similarity, poses are its own.
    """
    train, test = capture.split.train, capture.split.test
    measured = _poses(capture, capture, train)
    if len(train) < 3 or _on_a_line(measured):
        own = _poses(model.capture, capture, test)
    else:
        change = align(measured.double(), _poses(model.capture, capture, train).double())
        own = change(_poses(capture, capture, test).double()).float()
    return {int(frame): pose for frame, pose in zip(test, own, strict=True)}


def training_pose_errors(model: Model, capture: Capture) -> dict[str, Any] | None:
    """How far the training poses of a model are from the capture's, after the best similarity.

    Where the capture's poses are the true ones these are trajectory errors; else they tell how far
    refinement moved the poses.

    Returns:
        Absolute trajectory error and relative pose error (RMS) of the training frames in order of
        time; None where the model did not move poses, or a similarity is not determined.
    """
    train = capture.split.train
    if capture.frames is None or len(train) < 3:
        return None
    train = train[np.argsort(capture.frames.exposure.middle_us[train], kind="stable")]
    reference = _poses(capture, capture, train).double()
    if _on_a_line(reference):
        return None
    estimate = _poses(model.capture, capture, train).double()
    absolute, relative = absolute_error(estimate, reference), relative_error(estimate, reference)
    centre = reference[..., 3]
    spread = float((centre - centre.mean(0)).square().sum(-1).mean().sqrt())
    if absolute.translation < MOVED_SHARE * spread and absolute.rotation_deg < MOVED_DEG:
        return None
    return {
        "definition": "RMS over training frames of the difference from the capture's poses, in its"
        " units and degrees, after the best similarity; relative: of the motion between frames",
        "frames": len(train),
        "absolute": asdict(absolute),
        "relative": asdict(relative),
    }


def refine_poses(
    model: Model,
    capture: Capture,
    *,
    options: Refinement | None = None,
    start: Mapping[int, Pose] | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """Poses from which the renders of a model match the held-out images best.

    Args:
        model: Trained; it is not changed.
        capture: Holds the images.
        options: Options.
        start: Poses to begin with, by frame; by default the model's own.
        seed: Random seed of the choice of pixels.
        progress: Called with the steps done, and all.

    Raises:
        OptionError: No frame is held out, or the model knows no absolute brightness.
    """
    options = options or Refinement()
    views = _views(model, capture, start or {})
    device = device_of(model)
    twists = nn.Parameter(torch.zeros(len(views), 6, device=device))
    optimizers = (
        torch.optim.RMSprop([twists], options.rate),
        torch.optim.Adam([twists], options.rate),
    )
    first = best = last = _render_all(model, views, twists) if options.every else []
    with _frozen(model):
        for step in range(options.steps):
            random = numpy_generator(seed, step, "refine")
            sampled = [
                _sample(random, view, options, last[i : i + 1]) for i, view in enumerate(views)
            ]
            twists.grad = _gradient(model, views, twists, sampled, options.rays)
            optimizers[step >= RMSPROP_SHARE * options.steps].step()
            if options.every and ((step + 1) % options.every == 0 or step + 1 == options.steps):
                last = _render_all(model, views, twists)
                best = [
                    max(pair, key=lambda one: one.psnr) for pair in zip(best, last, strict=True)
                ]
            if progress is not None:
                progress(step + 1, options.steps)
    chosen = torch.stack([render.twist for render in best]) if best else twists.detach()
    refined = se3.compose(torch.stack([view.start for view in views]), se3.exp(chosen)).cpu()
    return Refined(
        poses={view.frame: pose for view, pose in zip(views, refined, strict=True)},
        before={view.frame: render.psnr for view, render in zip(views, first, strict=False)},
        after={view.frame: render.psnr for view, render in zip(views, best, strict=False)},
        protocol=_protocol(options),
    )


def _views(model: Model, capture: Capture, start: Mapping[int, Pose]) -> list[_View]:
    if model.capture.frames is None:
        raise OptionError(
            "poses cannot be refined with a model of events alone",
            got="a model whose brightness has an unknown gain and offset",
            do="evaluate without refinement",
        )
    device, references = device_of(model), held_out(capture)
    if not references:
        raise OptionError("poses cannot be refined: no frame is held out", where=capture.name)
    frames = np.array([reference.frame for reference in references])
    own = _poses(model.capture, capture, frames)
    middle = model.capture.clock.unit(capture.needed_frames.exposure.middle_us[frames])
    views = []
    shutter = Rolling.of(capture, along=model.capture.trajectory)
    for reference, pose, time in zip(references, own, middle, strict=True):
        assert reference.image is not None, "a held-out frame has its own image"
        pose0 = start.get(reference.frame, pose).to(device)
        track = torch.tensor(int(capture.needed_frames.track[reference.frame]))
        with torch.no_grad():
            rows = shutter.rows(torch.tensor(float(time)).to(device), track.to(device))
        rows = moved_rows(rows, pose, pose0)
        image = reference.image.to(device)
        views.append(_View(reference.frame, pose0, float(time), rows, image))
    return views


@contextmanager
def _frozen(model: Model) -> Iterator[None]:
    """Turn off the gradients of all parameters of the model."""
    assert isinstance(model, nn.Module), f"{type(model).__name__} is not an nn.Module"
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    try:
        for parameter in trainable:
            parameter.requires_grad_(False)
        yield
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)


def _gradient(
    model: Model,
    views: Sequence[_View],
    twists: Float[Tensor, "m 6"],
    sampled: Sequence[Int64[np.ndarray, "p"]],
    rays: int,
) -> Float[Tensor, "m 6"]:
    """Gradient of the error at the sampled pixels, for the twist of each view."""
    total = torch.zeros_like(twists)
    for i, part in _parts(sampled, rays):
        error = len(part) / len(sampled[i]) * _error(model, views[i], twists[i], part)
        total += torch.autograd.grad(error, twists)[0]
    return total


def _parts(
    sampled: Sequence[Int64[np.ndarray, "p"]], rays: int
) -> Iterator[tuple[int, Int64[np.ndarray, "q"]]]:
    """The pixels of each view, at most `rays` at once."""
    for i, pixels in enumerate(sampled):
        for first in range(0, len(pixels), rays):
            yield i, pixels[first : first + rays]


def _error(
    model: Model, view: _View, twist: Float[Tensor, "6"], pixels: Int64[np.ndarray, "q"]
) -> Float[Tensor, ""]:
    """Mean squared error of fine and coarse renders, display domain."""
    camera = model.capture.camera
    row, column = (torch.from_numpy(part).to(twist.device) for part in divmod(pixels, camera.width))
    pose = se3.compose(view.start, se3.exp(twist))
    if isinstance(model, ViewRenderer):
        rows = moved_rows(view.rows, view.start, pose)
        rendered = model.draw_views(whole(camera, pose, view.time, rows))[0, row, column, 0]
    else:
        xy = torch.stack([column, row], -1) + 0.5  # [q, 2], pixel centres
        ones = torch.ones_like(xy[:, 0])
        rendered = model.render(
            cast(camera, pose.expand(len(pixels), 3, 4), xy, view.time * ones, ones)
        )
    stored = view.image[row, column]  # [q, c]
    error = (model.encode(rendered.rgb) - stored).square().mean()
    if rendered.coarse is not None:
        error = error + (model.encode(rendered.coarse.rgb) - stored).square().mean()
    return error


def _sample(
    random: np.random.Generator, view: _View, options: Refinement, last: Sequence[_Render]
) -> Int64[np.ndarray, "p"]:
    """Random pixels of a view: uniform, or by their error if the PSNR is still low."""
    height, width, _ = view.image.shape
    if last and last[0].psnr < options.hard_psnr:
        error = last[0].error.double().cumsum(0).cpu().numpy()
        return np.searchsorted(error, random.random(options.pixels) * error[-1], side="right")
    return random.integers(height * width, size=options.pixels)


@torch.no_grad()
def _render_all(
    model: Model, views: Sequence[_View], twists: Float[Tensor, "m 6"]
) -> list[_Render]:
    """Render every view at its current pose."""
    found = []
    for view, twist in zip(views, twists.detach().clone(), strict=True):
        pose = se3.compose(view.start, se3.exp(twist))
        rows = moved_rows(view.rows, view.start, pose)
        light = render_view(renderer_of(model), model.capture.camera, pose, view.time, rows=rows)
        light = light.rgb.to(twist.device)
        image = model.encode(light).clamp(0, 1)
        stored = view.image.expand_as(image)
        error = (image - stored).square().mean(-1).reshape(-1)
        found.append(_Render(twist, float(psnr(image, stored)), error))
    return found


def _poses(posed: Capture, capture: Capture, frames: Int64[np.ndarray, "m"]) -> Tensor:
    """Poses on the trajectory of `posed` in the middle of the exposures of `capture`'s frames."""
    held, trajectory = capture.needed_frames, posed.trajectory
    time = torch.from_numpy(posed.clock.unit(held.exposure.middle_us[frames])).float()
    device = device_of(trajectory)
    track = torch.from_numpy(held.track[frames]).to(device)
    return Rolling.of(capture, along=trajectory).pose(time.to(device), track).detach().cpu()


def _on_a_line(poses: Float[Tensor, "m 3 4"]) -> bool:
    centre = poses[:, :, 3].double()
    spread = torch.linalg.svdvals(centre - centre.mean(0))
    return bool(spread[1] <= COLLINEAR * spread[0])


def _protocol(options: Refinement) -> dict[str, Any]:
    chosen = (
        f"best PSNR of full renders every {options.every} steps, per view, on the measured image"
        " (optimistic)"
        if options.every
        else "pose after the last step"
    )
    return {
        "pose_refinement": {**asdict(options), "optimizer": "RMSprop, then Adam", "chosen": chosen}
    }
