"""`sharpfield events`: the events that an event camera would report in a trained scene."""

from pathlib import Path

from tyro.conf import Positional

from sharpfield.cli.arguments import Device, parse_size, screen
from sharpfield.core.errors import OptionError
from sharpfield.twin.options import ExtraOptions, PixelOptions, ViewpointOptions

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
    from sharpfield.storage.event_formats import expect_format

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
