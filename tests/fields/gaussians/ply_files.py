"""Gaussians read back from the .ply files of splat viewers."""

from pathlib import Path

import torch

from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.storage.ply import read_splats


def import_splats(path: Path) -> Gaussians:
    """Read Gaussians from a .ply file; their colours are display values.

    Raises:
        CaptureError: The file is missing or truncated, or does not hold Gaussians.
    """
    table = read_splats(path)
    return Gaussians(
        torch.from_numpy(table.means),
        torch.from_numpy(table.quaternions),
        torch.from_numpy(table.log_scales),
        torch.from_numpy(table.opacity_logits),
        torch.from_numpy(table.harmonics),
    )
