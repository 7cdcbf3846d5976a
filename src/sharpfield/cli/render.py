"""`sharpfield render`: a video or images along a camera path."""

from pathlib import Path

from tyro.conf import Positional

from sharpfield.cli.arguments import Device, screen


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
