"""`sharpfield quality` and `sharpfield blur`: score the sharpness of frames; blur images."""

import json as json_format
from pathlib import Path

from tyro.conf import Positional

from sharpfield.captures.layout import ReadOptions
from sharpfield.cli.arguments import screen
from sharpfield.preparation.options import QualityOptions
from sharpfield.simulation.sensors.motion_blur import INTENSITY, PROBABILITY, SIZE

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
