"""`sharpfield inspect`: what a capture, or a file of events, holds.

`sharpfield deblur`: sharpen frames with their events, without training.

`sharpfield quality` and `sharpfield blur`: score the sharpness of frames; blur images.

`sharpfield calibrate`: contrast thresholds of the event camera, from frames and events.
"""

import json as json_format
from dataclasses import replace
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from sharpfield.captures.layout import ReadOptions
from sharpfield.cli.arguments import screen
from sharpfield.preparation.options import CalibrateOptions, DeblurOptions, QualityOptions
from sharpfield.simulation.sensors.motion_blur import INTENSITY, PROBABILITY, SIZE


def inspect_command(
    path: Positional[Path],
    json: bool = False,
    layout: str | None = None,
    event_unit: str | None = None,
    trust_pickle: bool = False,
) -> None:
    """Print what a capture, or a file of events, holds.

    Args:
        path: Folder of a capture, or a file of events.
        json: Print JSON instead of text.
        layout: Layout of the capture, if it is not recognised.
        event_unit: Unit of event times (ns, us, ms, s), where the file does not say.
        trust_pickle: Open pickled files, which may name programs to run; only arrays of numbers
            are built from them, and anything else is refused.
    """
    from sharpfield.captures.summary import path_summary

    options = ReadOptions(layout=layout, event_unit=event_unit, trust_pickle=trust_pickle)
    found = path_summary(path, options)
    print(json_format.dumps(found, indent=2) if json else as_text(found))


def as_text(found: dict[str, Any], indent: int = 0) -> str:
    """Nested values, a line each."""
    lines = []
    for key, value in found.items():
        if isinstance(value, dict):
            lines += [" " * indent + key, as_text(value, indent + 2)]
        else:
            shown = f"{value:,}" if isinstance(value, int) and value > 9999 else value
            lines.append(f"{' ' * indent}{key:<{22 - indent}} {shown}")
    return "\n".join(lines)


DEBLURRING = DeblurOptions()


def deblur_command(
    capture: Positional[Path],
    out: Path,
    layout: str | None = None,
    options: DeblurOptions = DEBLURRING,
) -> None:
    """Sharpen blurry frames with the event double integral; nothing is trained.

    Args:
        capture: Folder of the capture.
        out: Folder for the images, a contact sheet and `deblur.json`.
        layout: Layout of the capture, if it is not recognised.
        options: Thresholds, method, number of images.
    """
    from sharpfield.captures.read import read_capture
    from sharpfield.preparation.deblurring import deblur_to

    deblur_to(read_capture(capture, ReadOptions(layout=layout), poses=False), out, options)
    screen().print(f"Sharp frames are in {out}")


JUDGING = QualityOptions()
SHOWN = 12
"""Number of frames that are printed."""


def quality_command(
    capture: Positional[Path],
    json: bool = False,
    out: Path | None = None,
    layout: str | None = None,
    options: QualityOptions = JUDGING,
) -> None:
    """Score the sharpness of frames, independent of their content, and weight them by it.

    Args:
        capture: Folder of the capture.
        json: Print JSON with the score and weight of every frame.
        out: Folder for `quality.json`, `ranking.png` and `weights.npy`.
        layout: Layout of the capture, if it is not recognised.
        options: How sharpness is measured.
    """
    from rich.table import Table

    from sharpfield.captures.read import read_capture
    from sharpfield.preparation.quality import as_table, measure_quality, quality_to

    held = read_capture(capture, ReadOptions(layout=layout))
    found, measured_by = measure_quality(held, options)
    about = as_table(held, found, measured_by)
    if out is not None:
        quality_to(held, found, measured_by, out)
    if json:
        print(json_format.dumps(about, indent=2))
        return
    console = screen()
    ranked = sorted(about["frames"], key=lambda row: row["score"])
    shown = ranked if len(ranked) <= SHOWN else [*ranked[: SHOWN // 2], *ranked[-SHOWN // 2 :]]
    columns = list(shown[0])
    table = Table(
        *columns, title=f"{len(ranked)} frames, blurriest first, measured by {measured_by}"
    )
    for row in shown:
        cells = [row[key] if key == "name" else f"{row[key]:.3g}" for key in columns]
        table.add_row(*cells)
    console.print(table)
    if "rank_correlation" in about:
        said = f"Rank correlation with the true sharpness: {about['rank_correlation']:.3f}"
        console.print(said)
    if out is not None:
        console.print(f"The ranking is in {out}")


def blur_command(
    images: Positional[Path],
    out: Path,
    k: tuple[int, int] = SIZE,
    phi: tuple[float, float] = INTENSITY,
    probability: float = PROBABILITY,
    seed: int = 0,
) -> None:
    """Blur sharp images by random motion kernels, as Hybrid Neural Rendering did its test data.

    Args:
        images: Folder of PNG or JPEG images.
        out: Folder for the blurred images, of the same names and sizes, and `blur.json`.
        k: Range of kernel sizes in px; the upper end is excluded.
        phi: Range of the intensity 0...1: how crooked the motion is.
        probability: Fraction of images that are blurred.
        seed: Random seed of the kernels.
    """
    from sharpfield.preparation.quality import blur_images
    from sharpfield.simulation.sensors.motion_blur import KernelRange

    made = blur_images(images, out, ranges=KernelRange(k, phi, probability), seed=seed)
    count = sum(row["blurred"] for row in made)
    screen().print(f"{count} of {len(made)} images were blurred; see {out}")


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
    from sharpfield.preparation.calibrate.measure import IMAGE, calibration_text, write_calibration
    from sharpfield.preparation.calibrate.measure import calibrate as measure

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
