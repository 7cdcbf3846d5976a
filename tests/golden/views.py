"""One rendered view of a run."""

from pathlib import Path

import torch
from torch import Tensor

from sharpfield.rendering.view import render_view, renderer_of
from sharpfield.runs.run import open_run


def first_view(run: Path) -> tuple[int, Tensor]:
    """Number of parameters of a run's model, and the view of its first camera, half way."""
    opened = open_run(run, device="cpu")
    model = opened.model
    capture = model.capture
    time, track = torch.tensor(0.5), torch.tensor(0)
    with torch.no_grad():
        pose = capture.trajectory.pose(time, track)
        view = render_view(renderer_of(model), capture.camera, pose, time=0.5)
    return sum(p.numel() for p in model.parameters()), view.rgb
