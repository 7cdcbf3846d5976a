"""`sharpfield evaluate`: measure a run on held-out views."""

from pathlib import Path

from tyro.conf import Positional

from sharpfield.cli.arguments import Device, screen
from sharpfield.evaluation.options import Refinement

REFINEMENT = Refinement()


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
        refine=refinement if refine else None,
        train_views=train_views,
        lpips=lpips,
        console=console,
    )
    mean = {name: value for name, value in metrics["mean"].items() if value is not None}
    console.print("  ".join(f"{name} {value:.4g}" for name, value in mean.items()))
    console.print(f"The report is {run / 'report.html'}")
