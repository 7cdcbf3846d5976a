"""Merge models of blocks into one: each gives the Gaussians that lie in its own slab."""

from collections.abc import Sequence

import torch
from torch import Tensor

from sharpfield.captures.blocks import Block
from sharpfield.core.errors import OptionError
from sharpfield.fields.gaussians.static import Gaussians
from sharpfield.recipes.splats.model import SplatModel


def merge(models: Sequence[object], blocks: Sequence[Block]) -> SplatModel:
    """The first model with the Gaussians of all, static and moving.

    Its learned calibration (thresholds, gains, poses) is that of the first model.

    Args:
        models: Trained on one block each, in the order of `blocks`.
        blocks: Of one capture.

    Raises:
        OptionError: A model is not made of Gaussians, or their world frames differ.
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
            raise OptionError("the world frames of blocks differ", do="train them on one capture")
    for kind in ("static", "moving"):
        parts = [
            _inside(model, getattr(model.scene, kind), block)
            for model, block in zip(splats, blocks, strict=True)
            if getattr(model.scene, kind) is not None
        ]
        if parts:
            merged = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
            getattr(first.scene, kind).replace(merged)
    return first


def _inside(model: SplatModel, gaussians: Gaussians, block: Block) -> dict[str, Tensor]:
    """The parameters of the Gaussians whose means lie in a block."""
    means = model.change.inverse().points(gaussians.means.detach().cpu().double().numpy())
    inside = torch.from_numpy(block.contains(means)).to(gaussians.means.device)
    return {name: tensor.detach()[inside] for name, tensor in gaussians.points().items()}
