"""Gaussians to and from the files of splat viewers.

Viewers take what a file says as values for the display, and blend those. Our Gaussians hold what
the frames store, which is that already, or nearly; only where the frames are linear are colours
written through the sRGB curve: the base exactly, what changes with the direction by the slope of
the curve there. We blend light and viewers do not, so soft edges come out a little different.
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
from sharpfield.storage.splat_file import SplatTable, read_splats, write_splats

DIRECTIONS = 64
"""Along which harmonics are compared to turn them; 16 would do."""


def export_splats(
    gaussians: Gaussians,
    path: Path,
    *,
    encoding: str = "srgb",
    change: Similarity | None = None,
    comments: tuple[str, ...] = (),
) -> None:
    """Write Gaussians for viewers.

    Args:
        gaussians: Of one or three colours.
        path: Ends in .ply.
        encoding: Of what the Gaussians hold, see `Frames`.
        change: To another world, e.g. the capture's own; by default none.
        comments: What else to write into the header.
    """
    seen = gaussians if change is None else moved(gaussians, change)
    harmonics = seen.harmonics.detach().cpu()
    if encoding == "linear":
        harmonics = _displayed(harmonics)
    table = SplatTable(
        means=_array(seen.means),
        quaternions=_array(torch.nn.functional.normalize(seen.quaternions, dim=-1)),
        log_scales=_array(seen.log_scales),
        opacity_logits=_array(seen.opacity_logits),
        harmonics=_array(harmonics.expand(-1, -1, 3)),
        comments=comments,
    )
    write_splats(path, table)


def import_splats(path: Path) -> Gaussians:
    """Read Gaussians; their colours are values for the display.

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


def moved(gaussians: Gaussians, change: Similarity) -> Gaussians:
    """The same Gaussians in another world."""
    with torch.no_grad():
        turn = torch.as_tensor(change.rotation).to(gaussians.means)
        shift = torch.as_tensor(change.translation).to(gaussians.means)
        return Gaussians(
            change.scale * gaussians.means @ turn.T + shift,
            quaternion_from_rotation(turn @ rotation_from_quaternion(gaussians.quaternions)),
            gaussians.log_scales + float(np.log(change.scale)),
            gaussians.opacity_logits.clone(),
            _turned(gaussians.harmonics, turn),
        )


def _turned(
    harmonics: Float[Tensor, "n k c"], turn: Float[Tensor, "3 3"]
) -> Float[Tensor, "n k c"]:
    """Harmonics of the same colours when the world is turned: they agree in all directions."""
    degree = int(harmonics.shape[1] ** 0.5) - 1
    even = (torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5) / DIRECTIONS
    height, around = 1 - 2 * even, torch.pi * (1 + 5**0.5) * DIRECTIONS * even
    flat = (1 - height**2).sqrt()
    directions = torch.stack([flat * around.cos(), flat * around.sin(), height], -1)
    before = spherical_harmonics(directions, degree)
    after = spherical_harmonics(directions @ turn.T.double().cpu(), degree)
    mixing = torch.linalg.lstsq(after, before).solution.to(harmonics)
    return torch.einsum("jk,nkc->njc", mixing, harmonics)


def _displayed(harmonics: Float[Tensor, "n k c"]) -> Float[Tensor, "n k c"]:
    """Harmonics of linear light through the sRGB curve."""
    light = (GREY + FLAT * harmonics[:, :1]).detach().requires_grad_()
    with torch.enable_grad():
        shown = srgb(light)
        slope = torch.autograd.grad(shown.sum(), light)[0]
    return torch.cat([(shown.detach() - GREY) / FLAT, slope * harmonics[:, 1:]], 1)


def _array(values: Tensor) -> Float[np.ndarray, "..."]:
    return np.ascontiguousarray(values.detach().cpu().float().numpy())
