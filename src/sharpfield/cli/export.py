"""The command that gives a scene of Gaussians to other programs."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from sharpfield.cli.arguments import screen
from sharpfield.runs.run import expect_splat_file, open_run

Encoding = Literal["linear", "gamma2.2", "srgb"]


def export(
    run: Positional[Path],
    out: Path,
    encoding: Encoding | None = None,
    capture: Path | None = None,
) -> None:
    """Write the Gaussians of a run as a file for viewers of splats, in the capture's own world.

    Args:
        run: Folder that `train` made.
        out: The file, FILE.ply.
        encoding: How the colours of the Gaussians relate to light; by default as the frames say.
        capture: Where the capture is, if it moved.
    """
    expect_splat_file(out)  # before a run is opened
    count = open_run(run, capture=capture, device="cpu").export(out, encoding=encoding)
    screen().print(f"{count:,} Gaussians are in {out}")
