"""`sharpfield render`: a video or images along a camera path."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from sharpfield.cli.arguments import Device, screen

if TYPE_CHECKING:
    import numpy as np


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
    import torch
    from rich.progress import track

    from sharpfield.evaluation.paths import camera_path
    from sharpfield.rendering.view import render_view, renderer_of
    from sharpfield.report.video import write_video
    from sharpfield.runs.config import device_named
    from sharpfield.runs.run import open_run

    console = screen()
    opened = open_run(run, capture=capture, device=device)
    model, where = opened.model, device_named(device)
    poses = camera_path(opened.seen, path, images=frames)

    def rendered() -> "Iterator[np.ndarray]":
        silent = not console.is_terminal
        for number in track(range(len(poses)), "rendering", console=console, disable=silent):
            pose = torch.from_numpy(poses.poses[number]).to(where)
            time = float(poses.time[number])
            view = render_view(renderer_of(model), model.capture.camera, pose, time)
            stored = model.encode(view.rgb).clamp(0, 1)
            yield (stored * 255).round().byte().cpu().numpy()  # [h, w, 3]

    count = write_video(out, rendered(), rate=fps)
    console.print(f"{count} images are in {out}")
