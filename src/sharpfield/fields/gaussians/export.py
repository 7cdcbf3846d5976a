"""Gaussians to the .ply files of splat viewers.

Viewers treat the colours of a file as display values, and blend those. Our Gaussians hold stored
values of the frames, which are display values, or nearly; only where the frames are linear, colours
are converted to sRGB: the base harmonics exactly, the higher ones by the slope of the curve there.
We blend linear light and viewers do not, so soft edges come out a little different.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sharpfield.core.tone import srgb
from sharpfield.fields.gaussians.static import FLAT, GREY, Gaussians
from sharpfield.geometry.se3 import quaternion_from_rotation, rotation_from_quaternion
from sharpfield.geometry.space import Similarity
from sharpfield.ops.encoding import spherical_harmonics
from sharpfield.storage.ply import SplatTable, write_splats

DIRECTIONS = 64
"""In which spherical harmonics are evaluated to rotate them; 16 would do."""


def export_splats(
    gaussians: Gaussians,
    path: Path,
    *,
    encoding: str = "srgb",
    change: Similarity | None = None,
    comments: tuple[str, ...] = (),
) -> None:
    """Write Gaussians as a .ply file for splat viewers.

    Args:
        gaussians: Of one or three colours.
        path: Ends in .ply.
        encoding: Of the values that the Gaussians hold, see `Frames`.
        change: Transform to another world, e.g. the capture's own; by default none.
        comments: Lines of the header.
    """
    placed = gaussians if change is None else transformed(gaussians, change)
    harmonics = placed.harmonics.detach().cpu()
    if encoding == "linear":
        harmonics = _as_srgb(harmonics)
    table = SplatTable(
        means=_array(placed.means),
        quaternions=_array(torch.nn.functional.normalize(placed.quaternions, dim=-1)),
        log_scales=_array(placed.log_scales),
        opacity_logits=_array(placed.opacity_logits),
        harmonics=_array(harmonics.expand(-1, -1, 3)),
        comments=comments,
    )
    write_splats(path, table)


def transformed(gaussians: Gaussians, change: Similarity) -> Gaussians:
    """The same Gaussians in another world frame."""
    with torch.no_grad():
        rotation = torch.as_tensor(change.rotation).to(gaussians.means)
        shift = torch.as_tensor(change.translation).to(gaussians.means)
        return Gaussians(
            change.scale * gaussians.means @ rotation.T + shift,
            quaternion_from_rotation(rotation @ rotation_from_quaternion(gaussians.quaternions)),
            gaussians.log_scales + float(np.log(change.scale)),
            gaussians.opacity_logits.clone(),
            _rotated(gaussians.harmonics, rotation),
        )


def _rotated(
    harmonics: Float[Tensor, "n k c"], rotation: Float[Tensor, "3 3"]
) -> Float[Tensor, "n k c"]:
    """Spherical harmonics in a rotated world frame, fitted in many directions."""
    degree = int(harmonics.shape[1] ** 0.5) - 1
    even = (torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5) / DIRECTIONS
    height, around = 1 - 2 * even, torch.pi * (1 + 5**0.5) * DIRECTIONS * even
    flat = (1 - height**2).sqrt()
    directions = torch.stack([flat * around.cos(), flat * around.sin(), height], -1)
    before = spherical_harmonics(directions, degree)
    after = spherical_harmonics(directions @ rotation.T.double().cpu(), degree)
    mixing = torch.linalg.lstsq(after, before).solution.to(harmonics)
    return torch.einsum("jk,nkc->njc", mixing, harmonics)


def _as_srgb(harmonics: Float[Tensor, "n k c"]) -> Float[Tensor, "n k c"]:
    """Spherical harmonics of linear light, converted to sRGB."""
    light = (GREY + FLAT * harmonics[:, :1]).detach().requires_grad_()
    with torch.enable_grad():
        display = srgb(light)
        slope = torch.autograd.grad(display.sum(), light)[0]
    return torch.cat([(display.detach() - GREY) / FLAT, slope * harmonics[:, 1:]], 1)


def _array(values: Tensor) -> Float[np.ndarray, "..."]:
    return np.ascontiguousarray(values.detach().cpu().float().numpy())
