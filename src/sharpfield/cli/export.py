"""The command that gives a scene of Gaussians to other programs."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from sharpfield.cli.arguments import screen
from sharpfield.core.errors import OptionError
from sharpfield.fields.gaussians.export import export_splats
from sharpfield.recipes.splats.model import SplatModel
from sharpfield.runs.run import Run, open_run

ENDING = ".ply"

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
    if out.suffix != ENDING:
        raise OptionError("splats are exported as .ply", got=out, do=f"name a file FILE{ENDING}")
    opened = open_run(run, capture=capture, device="cpu")
    model = _with_gaussians(opened, run)
    scene = model.scene
    antialiased = ("antialiased",) if scene.splatting.antialiased else ()
    export_splats(
        scene.gaussians,
        out,
        encoding=encoding or model.encoding,
        change=model.change.inverse(),
        comments=(f"sharpfield {opened.config.name}", *antialiased),
    )
    screen().print(f"{len(scene.gaussians):,} Gaussians are in {out}")


def _with_gaussians(opened: Run, run: Path) -> SplatModel:
    if not isinstance(opened.model, SplatModel):
        raise OptionError(
            "this run holds no Gaussians",
            where=run,
            got=f"the recipe {opened.config.name}",
            do="export a run of one of the splat recipes; `sharpfield recipes` lists them",
        )
    return opened.model
