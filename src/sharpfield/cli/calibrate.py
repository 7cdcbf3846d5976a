"""`sharpfield calibrate`: contrast thresholds of the event camera, from frames and events."""

from dataclasses import replace
from pathlib import Path

from tyro.conf import Positional

from sharpfield.cli.arguments import screen
from sharpfield.preparation.options import CalibrateOptions

MEASURING = CalibrateOptions()


def calibrate_command(
    capture: Positional[Path],
    out: Path,
    write_capture: Path | None = None,
    options: CalibrateOptions = MEASURING,
) -> None:
    """Measure the thresholds of the event camera from frames and events, and find odd pixels.

    Args:
        capture: Folder of the capture; its poses are ignored.
        out: Folder for `calibration.json`, `pixels.npz` and `pixels.png`.
        write_capture: Also write the capture, with the thresholds found, to this folder.
        options: Exposure pairs, random seed.
    """
    from sharpfield.captures.native import layout as native
    from sharpfield.captures.read import read_capture
    from sharpfield.core.capture import Thresholds
    from sharpfield.preparation.calibrate.measure import calibrate as measure
    from sharpfield.preparation.calibrate.report import IMAGE, calibration_text, write_calibration

    held = read_capture(capture, poses=False)
    made = measure(held, options)
    about = write_calibration(held, made, out)
    console = screen()
    console.print(calibration_text(about), soft_wrap=True)
    console.print(f"Numbers and a map of the pixels are in {out}; see {out / IMAGE}")
    if write_capture is not None:
        measured = Thresholds(made.negative, made.positive, "estimated")
        known = replace(held.known, thresholds=measured)
        native.write(replace(held, known=known, name=write_capture.name), write_capture)
