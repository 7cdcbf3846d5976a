"""A trained run: what it shows, measured, and given to other programs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from rich.console import Console

from sharpfield.core.capture import Capture
from sharpfield.core.errors import RunError
from sharpfield.core.progress import progress_on
from sharpfield.evaluation.measure import EvaluationOptions, evaluate
from sharpfield.evaluation.refine import Refinement, refine_poses
from sharpfield.evaluation.report import RunDescription, write_report
from sharpfield.metrics.lpips import Lpips
from sharpfield.runs.config import RunConfig, device_named, read_run_config, used
from sharpfield.runs.views import At, depth_along_axis, encoded, mean_light, viewpoint
from sharpfield.training.checkpoint import file_of, load, restore_weights
from sharpfield.training.record import Ledger, read_ledger


@dataclass(frozen=True, repr=False)
class Run:
    """A trained run in its folder. `open_run` opens one, `train` makes one.

    Times are in us on the capture's clock; poses are world-from-camera in the capture's world
    (x right, y down, z forward).
    """

    folder: Path
    config: RunConfig
    """What it was started with."""
    model: Any
    """The trained `core.protocols.Model`, in a world of its own."""
    capture: Capture
    """All that was read, or its block; also what the model did not use."""

    def __repr__(self) -> str:
        ledger = self.ledger
        steps = f"{ledger.steps} of {ledger.planned_steps} steps"
        return f"Run({str(self.folder)!r}: {self.config.name} on {self.capture.name}, {steps})"

    @property
    def ledger(self) -> Ledger:
        """Steps done and planned, time and memory spent.

        Raises:
            RunError: Training has not begun, or its record is damaged.
        """
        return _needed_ledger(self.folder)

    @property
    def seen(self) -> Capture:
        """The capture in the model's world, also with frames that the model did not use."""
        own: Capture = self.model.capture
        if own.frames is not None:
            return own
        return replace(own, frames=self.capture.frames, split=self.capture.split)

    def render(
        self,
        at: At = None,
        *,
        time: float | int | None = None,
        exposure: float | int | bool = False,
        samples: int = 16,
    ) -> Float32[np.ndarray, "h w 3"]:
        """An image as the frames would store it, 0...1: sharp, or blurred by an exposure.

        Args:
            at: A frame by number, whose camera is followed; or a pose, [3, 4] or [4, 4], of a
                camera that stands still; or None for the camera of the first track.
            time: When, in us on the capture's clock; of an exposure, its middle. By default the
                middle of the frame's exposure, or of the capture.
            exposure: How long the shutter is open, in us; True for as long as the frame's was.
            samples: Sharp views whose mean an exposure is.

        Raises:
            OptionError: There is no such frame, or the time is outside the capture.
            ShapeError: The pose has another shape, or is none.
        """
        camera = viewpoint(self.model, self.capture, at, time)
        if exposure is not True:
            camera = replace(camera, exposure_us=float(exposure))
        light = mean_light(self.model, self.capture, camera, samples)
        return encoded(self.model, light)

    def depth(
        self, at: At = None, *, time: float | int | None = None
    ) -> Float32[np.ndarray, "h w"]:
        """Expected depth along the camera's axis, in units of the capture's world.

        Args:
            at: As for `render`.
            time: As for `render`.
        """
        camera = viewpoint(self.model, self.capture, at, time)
        return depth_along_axis(self.model, self.capture, camera)

    def evaluate(
        self,
        *,
        refine: Refinement | None = None,
        train_views: int | None = None,
        lpips: Lpips | None = None,
        baselines: Mapping[str, Mapping[str, Any]] | None = None,
        title: str = "",
        console: Console | None = None,
    ) -> dict[str, Any]:
        """Measure it on held-out views; write `metrics.json` and `report.html` into its folder.

        Args:
            refine: Refine the held-out poses first, with the scene frozen, and how.
            train_views: Most training views to render as well; None for all with known truth.
            lpips: With its weights, to compute LPIPS.
            baselines: Metrics of other methods, for the report; see `evaluation.measure`.
            title: Of the report.
            console: Where progress is shown.

        Returns:
            What is in `metrics.json`; the means over held-out views are under "mean".
        """
        volume = getattr(self.config.recipe, "volume", None)
        poses, stated = {}, {"near_plane_removal": getattr(volume, "clear_before", 0.0)}
        if refine is not None:
            found = refine_poses(self.model, self.capture, options=refine)
            poses, stated = found.poses, {**stated, **found.protocol}
        with progress_on(console or Console()) as progress:
            task = progress.add_task("rendering", total=None)
            metrics = evaluate(
                self.model,
                self.capture,
                self.folder,
                options=EvaluationOptions(
                    train_views=train_views, lpips=lpips, poses=poses, stated=stated
                ),
                baselines=baselines,
                progress=lambda done, total: progress.update(task, completed=done, total=total),
            )
        about = RunDescription(
            title=title or f"{self.config.name} on {self.capture.name}",
            paper=self.config.recipe.paper,
            settings=self.config.settings(),
        )
        write_report(self.folder, self.capture, metrics, about)
        return metrics


def open_run(folder: Path | str, *, capture: Path | str | None = None, device: str = "auto") -> Run:
    """A run with its trained weights.

    Args:
        folder: Of the run, as `train` made it.
        capture: Where the capture is now, if it moved; or another one of the same scene and clock.
        device: Where the model goes: auto, cpu or cuda.

    Raises:
        RunError: The run has no checkpoint yet, or is damaged.
        CaptureError: Its capture is gone, or cannot be read.
    """
    folder = Path(folder)
    config = read_run_config(folder)
    ledger = _needed_ledger(folder)
    whole = config.read_capture(folder, None if capture is None else Path(capture))
    recipe = config.recipe.lasting(ledger.planned_steps)
    model = recipe.build(used(whole, config.use), config.seed)
    restore_weights(load(file_of(folder, "last")), model)
    return Run(folder, config, model.to(device_named(device)), whole)


def _needed_ledger(folder: Path) -> Ledger:
    ledger = read_ledger(folder)
    if ledger is None:
        raise RunError("this run has not begun", where=folder, do="train it first")
    return ledger
