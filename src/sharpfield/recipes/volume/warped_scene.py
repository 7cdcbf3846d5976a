"""The scene of D-NeRF: a canonical radiance field and a deformation field.

A. Pumarola et al., *D-NeRF: Neural Radiance Fields for Dynamic Scenes*, CVPR 2021, as EvDNeRF (WACV
2024) uses it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.fields.mlp import MLPField
from sharpfield.fields.warp import AtZero, Deformation, Warped
from sharpfield.geometry.space import EvenDepth
from sharpfield.recipes.volume.scene import soft
from sharpfield.rendering.coarse_to_fine import CoarseToFine
from sharpfield.rendering.head_compositing import Compositing

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "sigmoid": torch.sigmoid,
    "relu": torch.relu,
    "softplus": soft,
}


@dataclass(frozen=True)
class WarpedOptions:
    """The networks, and their samples on rays. Defaults: the released code of EvDNeRF."""

    width: int = 256
    """Width of all layers."""
    depth: int = 8
    """Number of layers of each network."""
    networks: int = 1
    """Canonical networks: 1 for both stages, or 2, a coarse and a fine one."""
    colours: int = 1
    """Channels: 1 for grey, 3 for colour."""
    samples: tuple[int, int] = (64, 128)
    """Coarse samples on a ray, and fine samples added to them."""
    density: Literal["sigmoid", "relu", "softplus"] = "sigmoid"
    """Activation of the density per unit of length. The released sigmoid never exceeds 1, so
    that a wall half a unit thick lets 61 % through."""
    opaque_end: bool = True
    """Whether the last sample of a ray is opaque (released); else the background is black."""
    at_zero: AtZero = "exactly"
    """How the deformation vanishes at time 0, where the scene is the canonical one."""
    shared_jitter: bool = False
    """Whether both instants of a window have the same jitter; released: independent jitter, so that
    even static parts change."""


class WarpedScene(nn.Module):
    """A dynamic scene in the world and units of the capture.

    Args:
        options: Sizes and sampling.
        capture: As read.
        seed: Random seed of the run.
    """

    def __init__(self, options: WarpedOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.capture, self.seed = options, capture, seed
        self.path = capture.trajectory
        made = generator(seed, 0, "field")
        canonical = MLPField(
            generator=made,
            width=options.width,
            depth=options.depth,
            colours=options.colours,
            networks=options.networks,
        )
        deformation = Deformation(
            generator=made, width=options.width, depth=options.depth, at_zero=options.at_zero
        )
        self.field = Warped(canonical, deformation)
        how = Compositing(ACTIVATIONS[options.density], opaque_end=options.opaque_end)
        space = EvenDepth(capture.camera, capture.near, capture.far)
        self.view = CoarseToFine(self.field, space, options.samples, 0.0, how)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    def sharp(self, rays: Rays, step: int, stream: str) -> Radiance:
        """Training radiance along rays `[b, k]`: jittered samples, by seed, step and stream."""
        made = generator(self.seed, step, stream, self.device)
        if not self.options.shared_jitter:
            return self.view(rays, made)
        start = made.get_state()
        parts = []
        for k in range(rays.shape[1]):
            made.set_state(start)
            parts.append(self.view(rays[:, k : k + 1], made))
        return joined(parts)

    def groups(self, rate: Schedule) -> list[Group]:
        """Parameters of all networks with their learning rate."""
        return [Group("networks", tuple(self.parameters()), rate)]


def joined(parts: list[Radiance]) -> Radiance:
    """Radiances `[b, 1]` side by side, `[b, k]`."""

    def along(seen: list[Radiance]) -> Radiance:
        return Radiance(
            torch.cat([one.rgb for one in seen], 1),
            torch.cat([one.depth for one in seen], 1),
            torch.cat([one.opacity for one in seen], 1),
            torch.cat([one.weight for one in seen], 1),
        )

    coarse = [one.coarse for one in parts if one.coarse is not None]
    whole = along(parts)
    return Radiance(
        whole.rgb,
        whole.depth,
        whole.opacity,
        whole.weight,
        coarse=along(coarse) if coarse else None,
    )
