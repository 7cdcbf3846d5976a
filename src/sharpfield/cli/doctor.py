"""`sharpfield doctor`: check a capture before hours of training."""

import json as json_format
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from tyro.conf import Positional

from sharpfield.cli.arguments import screen
from sharpfield.core.files import write_json

if TYPE_CHECKING:
    from sharpfield.preparation.doctor.findings import Checkup

FINDINGS, PAGE = "doctor.json", "doctor.html"
STYLE = {"error": "bold red", "warning": "yellow", "note": "dim"}
UNSOUND = 1
"""Exit code when there are errors."""


def doctor_command(
    capture: Positional[Path],
    out: Path | None = None,
    json: bool = False,
    layout: str | None = None,
) -> None:
    """Check a capture: units, clocks, sensors, frames against events, thresholds, poses, blur.

    Exits with 1 if there is an error, so that scripts can stop there.

    Args:
        capture: Folder of the capture, with or without poses.
        out: Folder for `doctor.json`, `doctor.html` and its images.
        json: Print JSON instead of text.
        layout: Layout of the capture, if it is not recognised.
    """
    from sharpfield.preparation.doctor.checkup import examine_path, write_doctor_page
    from sharpfield.storage.images import write_image

    checkup, held = examine_path(capture, layout=layout)
    about = as_json(checkup)
    print(json_format.dumps(about, indent=2)) if json else _print(checkup)
    if out is not None:
        write_json(out / FINDINGS, about)
        for number, pixels in enumerate(checkup.images.values()):
            write_image(out / f"image_{number}.png", pixels)
        write_doctor_page(out / PAGE, checkup, held)
        if not json:
            screen().print(f"The page is {out / PAGE}", soft_wrap=True)
    if checkup.has("error"):
        sys.exit(UNSOUND)


def as_json(checkup: "Checkup") -> dict[str, Any]:
    """Plain values."""
    from sharpfield.preparation.doctor.checkup import verdict

    return {
        "capture": checkup.name,
        "verdict": verdict(checkup),
        "counts": checkup.counts,
        "findings": [asdict(one) for one in checkup.sorted],
        "images": {f"image_{i}.png": name for i, name in enumerate(checkup.images)},
    }


def _print(checkup: "Checkup") -> None:
    from sharpfield.preparation.doctor.checkup import verdict

    console = screen()
    for one in checkup.sorted:
        style = STYLE[one.severity]
        console.print(
            f"[{style}]{one.severity:<8}[/] {escape(one.check)}: {escape(one.what)}", soft_wrap=True
        )
        for label, text in (("got", one.got), ("do", one.do)):
            if text:
                console.print(f"  {label:<6} {escape(text)}", soft_wrap=True)
    console.print(f"{verdict(checkup)}.", soft_wrap=True)
