"""`sharpfield evaluate`, `render` and `export`: what a trained run looks like.

`sharpfield events`: the events that an event camera would report in a trained scene.
"""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from sharpfield.cli.arguments import Device, parse_size, screen
from sharpfield.core.errors import OptionError
from sharpfield.evaluation.options import Refinement
from sharpfield.twin.options import ExtraOptions, PixelOptions, ViewpointOptions

REFINEMENT = Refinement()

Encoding = Literal["linear", "gamma2.2", "srgb"]


def evaluate_command(
    run: Positional[Path],
    capture: Path | None = None,
    device: Device = "auto",
    refine: bool = False,
    refinement: Refinement = REFINEMENT,
    train_views: int | None = None,
    lpips_backbone: Path | None = None,
    lpips_linear: Path | None = None,
) -> None:
    """Measure a run on held-out views; write metrics.json and report.html into it.

    Args:
        run: Folder of the run.
        capture: Folder of the capture, if it moved.
        device: Device to render on.
        refine: Refine the poses of the held-out views first, with the scene frozen.
        refinement: How poses are refined.
        train_views: Maximum number of training views to render as well; by default all views with
            a sharp reference.
        lpips_backbone: Weights file of torchvision's AlexNet or VGG16, to compute LPIPS.
        lpips_linear: Weights file of LPIPS's own linear layers.
    """
    from sharpfield.metrics.lpips import load_lpips
    from sharpfield.runs.run import open_run

    console = screen()
    opened = open_run(run, capture=capture, device=device)
    lpips = None
    if lpips_backbone is not None and lpips_linear is not None:
        lpips = load_lpips(lpips_backbone, lpips_linear)
    metrics = opened.evaluate(
        refine=refinement if refine else None, train_views=train_views, lpips=lpips, console=console
    )
    mean = {name: value for name, value in metrics["mean"].items() if value is not None}
    console.print("  ".join(f"{name} {value:.4g}" for name, value in mean.items()))
    console.print(f"The report is {run / 'report.html'}")


def render_command(
    run: Positional[Path],
    out: Path,
    path: str = "spiral",
    frames: int = 60,
    fps: float = 30.0,
    capture: Path | None = None,
    device: Device = "auto",
) -> None:
    """Render a run along a camera path.

    Args:
        run: Folder of the run.
        out: A video FILE.mp4, or a folder for PNG images.
        path: Camera path: spiral, train, or exposure:N for the motion inside exposure N.
        frames: Number of frames to render.
        fps: Frames per second of the video.
        capture: Folder of the capture, if it moved.
        device: Device to render on.
    """
    from sharpfield.runs.run import open_run

    console = screen()
    opened = open_run(run, capture=capture, device=device)
    count = opened.video(out, path=path, frames=frames, fps=fps, console=console)
    console.print(f"{count} images are in {out}")


def export_command(
    run: Positional[Path],
    out: Path,
    encoding: Encoding | None = None,
    time: int | None = None,
    sequence: int | None = None,
    capture: Path | None = None,
) -> None:
    """Write the Gaussians of a run as a file for viewers of splats, in the capture's own world.

    Args:
        run: Folder of the run.
        out: File to write, FILE.ply.
        encoding: Encoding of the colours of the Gaussians; by default that of the frames.
        time: Of a moving scene, the instant to export, in us on the capture's clock; by default
            the middle of the capture.
        sequence: Export a moving scene at this many instants from the beginning of the capture to
            its end, as FILE_0000.ply, FILE_0001.ply, and so on.
        capture: Folder of the capture, if it moved.
    """
    from sharpfield.runs.run import expect_splat_file, open_run

    expect_splat_file(out)  # before a run is opened
    if time is not None and sequence is not None:
        raise OptionError("an instant or a sequence", got="--time and --sequence", do="give one")
    opened = open_run(run, capture=capture, device="cpu")
    if sequence is not None:
        files = opened.export_sequence(out, sequence, encoding=encoding)
        screen().print(f"{len(files):,} instants are in {files[0]} to {files[-1].name}")
        return
    count = opened.export(out, encoding=encoding, time=time)
    screen().print(f"{count:,} Gaussians are in {out}")


VIEWPOINT, PIXELS, EXTRA = ViewpointOptions(), PixelOptions(), ExtraOptions()


def events_command(
    run: Positional[Path],
    out: Path,
    viewpoint: ViewpointOptions = VIEWPOINT,
    pixels: PixelOptions = PIXELS,
    extra: ExtraOptions = EXTRA,
    capture: Path | None = None,
    device: Device = "auto",
) -> None:
    """Render the events that a camera would report in a trained scene.

    Args:
        run: Folder of the run.
        out: Event file to write: FILE.h5, FILE.raw, FILE.npz or FILE.csv.
        viewpoint: Camera, path, time.
        pixels: Sensor and time steps.
        extra: Event frames, comparison.
        capture: Folder of the capture, if it moved.
        device: Device to render on.
    """
    extra.expect_comparable(viewpoint)
    from sharpfield.runs.event_files import write_events
    from sharpfield.runs.run import open_run
    from sharpfield.storage.event_writer import expect_format

    expect_format(out)
    opened = open_run(run, capture=capture, device=device)
    size = _resolution(viewpoint.size, pixels.sensor)
    write_events(opened, out, viewpoint, pixels, extra, size=size, console=screen())


def _resolution(size: str | None, sensor: str) -> tuple[int, int] | None:
    """The resolution that was asked for: in pixels, or that of a named sensor."""
    from sharpfield.simulation.sensors.event_pixels import SIZES

    if size != "sensor":
        return None if size is None else parse_size(size)
    if sensor not in SIZES:
        raise OptionError(
            "this sensor has no size of its own", got=sensor, do=f"name one of {', '.join(SIZES)}"
        )
    return SIZES[sensor]
