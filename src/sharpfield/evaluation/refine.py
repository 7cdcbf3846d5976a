"""Refining the poses of held-out views on a finished model, before measuring it.

Where training poses were estimated or refined, the space of the model is not quite the space of
the held-out poses, and a shift of a pixel costs more PSNR than any blur. So the held-out poses are
first brought to the model's space by a similarity (`aligned_poses`) and then each is improved by
gradient descent on the difference between render and image, with the model frozen
(`refine_poses`).

The better of all poses looked at is chosen by the PSNR on the very image that is then measured,
which is optimistic by construction; the protocol says so.

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
from sharpfield.core.device import device_of
from sharpfield.core.errors import OptionError
from sharpfield.core.protocols import Model
from sharpfield.core.seed import numpy_generator
from sharpfield.evaluation.views import held_out
from sharpfield.geometry import se3
from sharpfield.geometry.cast import cast
from sharpfield.geometry.rolling import Rolling, moved_rows
from sharpfield.metrics.image import psnr
from sharpfield.metrics.pose import align
from sharpfield.rendering.splat import whole
from sharpfield.rendering.view import CHUNK, ViewRenderer, render_view, renderer_of

Pose = Float[Tensor, "3 4"]

LINE = 1e-3
"""Camera centres whose spread in the second direction is this part of that in the first lie on a
line, which leaves a similarity free to turn about it."""

FIRST_OPTIMIZER = 0.67
"""Part of the steps done by RMSprop; Adam does the rest."""


@dataclass(frozen=True)
class Refinement:
    """How poses are refined. The published numbers are 5000 steps; 1e-5 for synthetic scenes."""

    steps: int = 500
    """Steps of gradient descent."""
    pixels: int = 300
    """Random pixels of each view and step."""
    rate: float = 1e-4
    """Learning rate of the twists, in rad and units of the model's space."""
    every: int = 100
    """Steps between full renders, which the best pose of each view is chosen by; 0 takes the last
    pose without looking."""
    hard_psnr: float = 19.0
    """Views below this (dB) draw pixels in proportion to their squared error."""
    rays: int = CHUNK
    """Most rays rendered at once."""


@dataclass(frozen=True)
class Refined:
    """Poses of the held-out frames in the model's space, and what they brought."""

    poses: dict[int, Pose]
    """By frame; on the CPU."""
    before: dict[int, float]
    """PSNR (dB) of each frame at the start; empty without full renders."""
    after: dict[int, float]
    """PSNR at the chosen pose."""
    protocol: dict[str, Any]
    """What to state beside numbers measured at these poses."""


@dataclass(frozen=True)
class _View:
    frame: int
    start: Pose
    time: float
    rows: Float[Tensor, "q 3 4"] | None
    """At the start, with a rolling shutter."""
    image: Float[Tensor, "h w c"]


@dataclass(frozen=True)
class _Seen:
    """What a full render of a view at some pose showed."""

    twist: Float[Tensor, "6"]
    psnr: float
    error: Float[Tensor, "p"]
    """Squared error of each pixel."""


def aligned_poses(model: Model, capture: Capture) -> dict[int, Pose]:
    """Poses of the held-out frames, brought to the model's space by the training frames.

    Args:
        model: Its own capture may have refined poses, or be in another space altogether.
        capture: With the poses as they were measured.

    Returns:
        For each held-out frame a pose; the model's own where fewer than three training cameras,
        or cameras on one line, do not fix a similarity.
    """
    train, test = capture.split.train, capture.split.test
    measured = _poses(capture, capture, train)
    if len(train) < 3 or _on_a_line(measured):
        own = _poses(model.capture, capture, test)
    else:
        change = align(measured.double(), _poses(model.capture, capture, train).double())
        own = change(_poses(capture, capture, test).double()).float()
    return {int(frame): pose for frame, pose in zip(test, own, strict=True)}


def refine_poses(
    model: Model,
    capture: Capture,
    *,
    how: Refinement | None = None,
    start: Mapping[int, Pose] | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """Poses from which the model's renders look most like the held-out images.

    Args:
        model: Trained; it is not changed.
        capture: Holds the images.
        how: Options.
        start: Poses to begin with, by frame; by default the model's own.
        seed: For the choice of pixels.
        progress: Called with the steps done, and all.

    Raises:
        OptionError: No frame is held out, or the model knows no absolute brightness.
    """
    how = how or Refinement()
    views = _views(model, capture, start or {})
    home = device_of(model)
    twists = nn.Parameter(torch.zeros(len(views), 6, device=home))
    optimizers = (torch.optim.RMSprop([twists], how.rate), torch.optim.Adam([twists], how.rate))
    first = best = last = _look(model, views, twists) if how.every else []
    with _frozen(model):
        for step in range(how.steps):
            random = numpy_generator(seed, step, "refine")
            drawn = [_draw(random, view, how, last[i : i + 1]) for i, view in enumerate(views)]
            twists.grad = _gradient(model, views, twists, drawn, how.rays)
            optimizers[step >= FIRST_OPTIMIZER * how.steps].step()
            if how.every and ((step + 1) % how.every == 0 or step + 1 == how.steps):
                last = _look(model, views, twists)
                best = list(map(_better, best, last))
            if progress is not None:
                progress(step + 1, how.steps)
    chosen = torch.stack([seen.twist for seen in best]) if best else twists.detach()
    moved = se3.compose(torch.stack([view.start for view in views]), se3.exp(chosen)).cpu()
    return Refined(
        poses={view.frame: pose for view, pose in zip(views, moved, strict=True)},
        before={view.frame: seen.psnr for view, seen in zip(views, first, strict=False)},
        after={view.frame: seen.psnr for view, seen in zip(views, best, strict=False)},
        protocol=_protocol(how),
    )


def _views(model: Model, capture: Capture, start: Mapping[int, Pose]) -> list[_View]:
    if model.capture.frames is None:
        raise OptionError(
            "poses cannot be refined with a model of events alone",
            got="a model that knows brightness up to an unknown gain and offset",
            do="evaluate without refinement",
        )
    home, references = device_of(model), held_out(capture)
    if not references:
        raise OptionError("poses cannot be refined: no frame is held out", where=capture.name)
    frames = np.array([reference.frame for reference in references])
    own = _poses(model.capture, capture, frames)
    middle = model.capture.clock.unit(capture.needed_frames.exposure.middle_us[frames])
    views = []
    shutter = Rolling.of(capture, along=model.capture.trajectory)
    for reference, pose, time in zip(references, own, middle, strict=True):
        assert reference.image is not None, "a held-out frame has its own image"
        begin = start.get(reference.frame, pose).to(home)
        track = torch.tensor(int(capture.needed_frames.track[reference.frame]))
        with torch.no_grad():
            rows = shutter.rows(torch.tensor(float(time)).to(home), track.to(home))
        rows = moved_rows(rows, pose, begin)
        image = reference.image.to(home)
        views.append(_View(reference.frame, begin, float(time), rows, image))
    return views


def _better(one: _Seen, other: _Seen) -> _Seen:
    return other if other.psnr > one.psnr else one


@contextmanager
def _frozen(model: Model) -> Iterator[None]:
    """Spare the gradients of everything the model has learned."""
    assert isinstance(model, nn.Module), f"{type(model).__name__} is not an nn.Module"
    learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
    try:
        for parameter in learned:
            parameter.requires_grad_(False)
        yield
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)


def _gradient(
    model: Model,
    views: Sequence[_View],
    twists: Float[Tensor, "m 6"],
    drawn: Sequence[Int64[np.ndarray, "p"]],
    rays: int,
) -> Float[Tensor, "m 6"]:
    """Gradient of the error at the drawn pixels, for each view's twist."""
    total = torch.zeros_like(twists)
    for i, part in _parts(drawn, rays):
        error = len(part) / len(drawn[i]) * _error(model, views[i], twists[i], part)
        total += torch.autograd.grad(error, twists)[0]
    return total


def _parts(
    drawn: Sequence[Int64[np.ndarray, "p"]], rays: int
) -> Iterator[tuple[int, Int64[np.ndarray, "q"]]]:
    """Each view's pixels, at most so many at once."""
    for i, pixels in enumerate(drawn):
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
        seen = model.draw_views(whole(camera, pose, view.time, rows))[0, row, column, 0]
    else:
        xy = torch.stack([column, row], -1) + 0.5
        ones = torch.ones_like(xy[:, 0])
        seen = model.render(
            cast(camera, pose.expand(len(pixels), 3, 4), xy, view.time * ones, ones)
        )
    stored = view.image[row, column]
    error = (model.encode(seen.rgb) - stored).square().mean()
    if seen.coarse is not None:
        error = error + (model.encode(seen.coarse.rgb) - stored).square().mean()
    return error


def _draw(
    random: np.random.Generator, view: _View, how: Refinement, last: Sequence[_Seen]
) -> Int64[np.ndarray, "p"]:
    """Pixels of a view: uniform, or where the error is if the view is still far off."""
    height, width, _ = view.image.shape
    if last and last[0].psnr < how.hard_psnr:
        error = last[0].error.double().cumsum(0).cpu().numpy()
        return np.searchsorted(error, random.random(how.pixels) * error[-1], side="right")
    return random.integers(height * width, size=how.pixels)


@torch.no_grad()
def _look(model: Model, views: Sequence[_View], twists: Float[Tensor, "m 6"]) -> list[_Seen]:
    """Render every view as it is now."""
    found = []
    for view, twist in zip(views, twists.detach().clone(), strict=True):
        pose = se3.compose(view.start, se3.exp(twist))
        rows = moved_rows(view.rows, view.start, pose)
        light = render_view(renderer_of(model), model.capture.camera, pose, view.time, rows=rows)
        light = light.rgb.to(twist.device)
        image = model.encode(light).clamp(0, 1)
        stored = view.image.expand_as(image)
        error = (image - stored).square().mean(-1).reshape(-1)
        found.append(_Seen(twist, float(psnr(image, stored)), error))
    return found


def _poses(model_side: Capture, capture: Capture, frames: Int64[np.ndarray, "m"]) -> Tensor:
    """Where `model_side` has the camera in the middle of the exposures of `capture`'s frames."""
    held, trajectory = capture.needed_frames, model_side.trajectory
    time = torch.from_numpy(model_side.clock.unit(held.exposure.middle_us[frames])).float()
    home = device_of(trajectory)
    track = torch.from_numpy(held.track[frames]).to(home)
    return Rolling.of(capture, along=trajectory).pose(time.to(home), track).detach().cpu()


def _on_a_line(poses: Float[Tensor, "m 3 4"]) -> bool:
    centre = poses[:, :, 3].double()
    spread = torch.linalg.svdvals(centre - centre.mean(0))
    return bool(spread[1] <= LINE * spread[0])


def _protocol(how: Refinement) -> dict[str, Any]:
    chosen = (
        f"best PSNR of full renders every {how.every} steps, per view, on the measured image"
        " (optimistic)"
        if how.every
        else "pose after the last step"
    )
    return {"pose_refinement": {**asdict(how), "optimizer": "RMSprop, then Adam", "chosen": chosen}}
