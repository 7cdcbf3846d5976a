"""A trained run: what it shows, measured, and given to other programs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from rich.console import Console
from rich.progress import track

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError, RunError
from sharpfield.core.events import EventStream
from sharpfield.core.progress import progress_on
from sharpfield.core.struct import device_of
from sharpfield.evaluation.measure import EvaluationOptions, evaluate
from sharpfield.evaluation.options import Refinement
from sharpfield.evaluation.paths import camera_path
from sharpfield.evaluation.refine import refine_poses
from sharpfield.evaluation.report import RunDescription, write_report
from sharpfield.fields.gaussians.export import export_splats
from sharpfield.metrics.lpips import Lpips
from sharpfield.recipes.splats.model import SplatModel
from sharpfield.rendering.view import render_view, renderer_of
from sharpfield.report.colormaps import eight_bit
from sharpfield.report.video import write_video
from sharpfield.runs.config import RunConfig, device_named, read_run_config, used
from sharpfield.runs.events import TimedPoses, event_sensor, event_viewpoint, render_events
from sharpfield.runs.views import At, depth_along_axis, encoded, mean_light, view_spec
from sharpfield.simulation.sensors.event_pixels import EventSensor
from sharpfield.training.checkpoint import file_of, load, restore_weights
from sharpfield.training.status import TrainingStatus, read_status
from sharpfield.twin.event_twin import TIME_STEPS, TimeSteps
from sharpfield.twin.options import RECORDED


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
        status = self.status
        steps = f"{status.steps} of {status.planned_steps} steps"
        return f"Run({str(self.folder)!r}: {self.config.name} on {self.capture.name}, {steps})"

    @property
    def status(self) -> TrainingStatus:
        """Steps done and planned, time and memory spent.

        Raises:
            RunError: Training has not begun, or its record is damaged.
        """
        return _needed_status(self.folder)

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
        camera = view_spec(self.model, self.capture, at, time)
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
        camera = view_spec(self.model, self.capture, at, time)
        return depth_along_axis(self.model, self.capture, camera)

    def events(
        self,
        path: int | TimedPoses = 0,
        *,
        start: float | int | None = None,
        end: float | int | None = None,
        size: tuple[int, int] | None = None,
        sensor: str | EventSensor = RECORDED,
        time_steps: TimeSteps = TIME_STEPS,
        subpixels: int = 1,
        seed: int = 0,
    ) -> EventStream:
        """The events that a camera would report in the scene.

        Args:
            path: Number of a camera track of the capture; or times in us and the poses then.
            start: The camera is switched on then, in us; by default where its path begins.
            end: Its last event is before; by default where its path ends.
            size: Width and height of the sensor in px; by default the capture's.
            sensor: "recorded" for ideal pixels with the thresholds that the capture states; ideal,
                dvs346, gen3-vga, gen4-hd; or the numbers of one.
            time_steps: How finely time is stepped.
            subpixels: Along each side of a pixel, whose light is their mean.
            seed: Random seed of what differs from pixel to pixel, and of noise.

        Raises:
            OptionError: There is no such track or sensor, or the path does not last from `start`
                to `end`.
        """
        if isinstance(sensor, str):
            sensor = event_sensor(self.capture, sensor)
        camera = event_viewpoint(self.model, self.capture, path, size)
        return render_events(
            self.model,
            camera,
            sensor,
            (start, end),
            time_steps=time_steps,
            subpixels=subpixels,
            seed=seed,
        )

    def export(
        self,
        path: Path | str,
        *,
        encoding: Literal["linear", "gamma2.2", "srgb"] | None = None,
        time: float | int | None = None,
    ) -> int:
        """Write the Gaussians as a .ply file for viewers of splats, in the capture's world.

        Args:
            path: The file, FILE.ply.
            encoding: How the colours of the Gaussians relate to light; by default as the frames
                say.
            time: Of a moving scene, the instant, in us on the capture's clock; by default the
                middle of the capture. The background is not written.

        Returns:
            How many Gaussians there are.

        Raises:
            OptionError: The run holds no Gaussians, or the file has another ending.
        """
        path, model = expect_splat_file(Path(path)), self.model
        if not isinstance(model, SplatModel):
            raise OptionError(
                "this run holds no Gaussians",
                where=self.folder,
                got=f"the recipe {self.config.name}",
                do="export a run of one of the splat recipes; `sharpfield recipes` lists them",
            )
        clock = self.capture.clock
        unit = 0.5 if time is None else (time - clock.origin_us) / clock.span_us
        if not 0 <= unit <= 1:
            raise OptionError(
                "the time is outside the capture",
                where=self.folder,
                got=f"{time} us",
                do=f"choose one from {clock.origin_us} to {clock.origin_us + clock.span_us} us",
            )
        gaussians = model.scene.gaussians_at(unit)
        antialiased = ("antialiased",) if model.scene.splatting.antialiased else ()
        export_splats(
            gaussians,
            path,
            encoding=encoding or model.encoding,
            change=model.change.inverse(),
            comments=(f"sharpfield {self.config.name}", *antialiased),
        )
        return len(gaussians)

    def export_sequence(
        self,
        path: Path | str,
        count: int,
        *,
        encoding: Literal["linear", "gamma2.2", "srgb"] | None = None,
    ) -> list[Path]:
        """Write a moving scene as numbered .ply files, one for each of some instants.

        Args:
            path: FILE.ply, for FILE_0000.ply, FILE_0001.ply, and so on.
            count: How many instants, evenly from the beginning of the capture to its end.
            encoding: As for `export`.

        Returns:
            The files.
        """
        path, clock = expect_splat_file(Path(path)), self.capture.clock
        files = []
        for number in range(count):
            time = clock.origin_us + clock.span_us * number / max(count - 1, 1)
            files.append(path.with_name(f"{path.stem}_{number:04d}.ply"))
            self.export(files[-1], encoding=encoding, time=time)
        return files

    def video(
        self,
        out: Path | str,
        *,
        path: str = "spiral",
        frames: int = 60,
        fps: float | int = 30,
        console: Console | None = None,
    ) -> int:
        """Render images along a camera path.

        Args:
            out: A video FILE.mp4, or a folder for PNG files.
            path: spiral, train, or exposure:N for the inside of the exposure of frame N.
            frames: How many images.
            fps: Frames per second of the video.
            console: Where progress is shown.

        Returns:
            How many images were written.

        Raises:
            OptionError: There is no such path.
        """
        model, console = self.model, console or Console()
        moves = camera_path(self.seen, path, images=frames)

        def rendered(number: int) -> UInt8[np.ndarray, "h w c"]:
            pose = torch.from_numpy(moves.poses[number]).to(device_of(model))
            seen = render_view(
                renderer_of(model), model.capture.camera, pose, float(moves.time[number])
            )
            with torch.no_grad():
                return eight_bit(model.encode(seen.rgb.to(device_of(model))).cpu().numpy())

        numbers = track(
            range(len(moves)), "rendering", console=console, disable=not console.is_terminal
        )
        return write_video(Path(out), (rendered(number) for number in numbers), fps=float(fps))

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
    status = _needed_status(folder)
    whole = config.read_capture(folder, None if capture is None else Path(capture))
    recipe = config.recipe.lasting(status.planned_steps)
    model = recipe.build(used(whole, config.use), config.seed)
    restore_weights(load(file_of(folder, "last")), model)
    return Run(folder, config, model.to(device_named(device)), whole)


def expect_splat_file(path: Path) -> Path:
    """The path itself, if Gaussians can be exported to it.

    Raises:
        OptionError: It has another ending than .ply.
    """
    if path.suffix != ".ply":
        raise OptionError("splats are exported as .ply", got=path, do="name a file FILE.ply")
    return path


def _needed_status(folder: Path) -> TrainingStatus:
    status = read_status(folder)
    if status is None:
        raise RunError("this run has not begun", where=folder, do="train it first")
    return status
