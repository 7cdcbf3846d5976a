"""Models of blocks, made one: each gives the Gaussians that lie in its own slab."""

from collections.abc import Sequence

import torch
from torch import Tensor

from sharpfield.captures.blocks import Block
from sharpfield.core.errors import OptionError
from sharpfield.recipes.splats.model import SplatModel


def merge(models: Sequence[object], blocks: Sequence[Block]) -> SplatModel:
    """The first model, with the Gaussians of all from now on.

    What else the models learned (thresholds, gains, poses) is the first one's.

    Args:
        models: Trained on one block each, in the order of `blocks`.
        blocks: Of one capture.

    Raises:
        OptionError: A model is not made of Gaussians, or they live in different worlds.
    """
    splats = [model for model in models if isinstance(model, SplatModel)]
    if len(splats) != len(models):
        raise OptionError(
            "only scenes of Gaussians can be merged",
            got=", ".join(sorted({type(model).__module__ for model in models})),
            do="train a splat recipe, such as room-splat",
        )
    first = splats[0]
    for other in splats[1:]:
        if abs(other.change.scale / first.change.scale - 1) > 1e-9:
            raise OptionError("the blocks live in different worlds", do="train them on one capture")
    parts = [_own(model, block) for model, block in zip(splats, blocks, strict=True)]
    first.scene.static.replace(
        {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    )
    return first


def _own(model: SplatModel, block: Block) -> dict[str, Tensor]:
    gaussians = model.scene.static
    places = model.change.inverse().points(gaussians.means.detach().cpu().double().numpy())
    inside = torch.from_numpy(block.holds(places)).to(gaussians.means.device)
    return {name: tensor.detach()[inside] for name, tensor in gaussians.points().items()}
