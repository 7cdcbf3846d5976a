"""The smallest model whose points grow: a colour at a place is a sum of blobs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from sharpfield.core.measurements import Batch
from sharpfield.core.protocols import Growth, PointSet
from sharpfield.core.schedule import Group, constant
from sharpfield.core.seed import generator
from tests.training.toy import Toy

EVERY = 4
"""Steps between growths."""


class Blobs(nn.Module):
    """Places and colours, and how strongly each was pulled since the last growth."""

    pulled: Tensor

    def __init__(self, count: int) -> None:
        super().__init__()
        chance = generator(0, 0, "blobs")
        self.places = nn.Parameter(torch.rand(count, 2, generator=chance))
        self.colours = nn.Parameter(torch.rand(count, 3, generator=chance) / count)
        self.register_buffer("pulled", torch.zeros(count))

    def forward(self, xy: Tensor) -> Tensor:
        far = (xy[:, None] - self.places).square().sum(-1)  # [b, n]
        return (-4 * far).exp() @ self.colours

    def points(self) -> dict[str, Tensor]:
        return {"places": self.places, "colours": self.colours, "pulled": self.pulled}

    def replace(self, points: Mapping[str, Tensor]) -> None:
        for name, rows in points.items():
            learns = name != "pulled"
            setattr(self, name, nn.Parameter(rows.detach()) if learns else rows)


class GrowingToy(Toy):
    """Drops the blob that was pulled least, and splits the two that were pulled most."""

    def __init__(self, steps: int) -> None:
        super().__init__(steps)
        self.blobs = Blobs(6)

    def losses(self, batch: Batch, step: int) -> dict[str, Tensor]:
        seen = batch["frames"]
        return super().losses(batch, step) | {
            "blobs": (self.blobs(seen.xy) - seen.value).square().mean()
        }

    def grow(self, step: int) -> Sequence[tuple[PointSet, Growth]]:
        blobs = self.blobs
        assert blobs.places.grad is not None
        blobs.pulled += blobs.places.grad.norm(dim=-1)
        if (step + 1) % EVERY:
            return []
        order = blobs.pulled.argsort(stable=True)
        source = torch.cat([order[1:].sort().values, order[-2:]])
        fresh = torch.arange(len(source)) >= len(source) - 2
        places = blobs.places.detach()[source]
        moved = 0.02 * torch.randn(2, 2, generator=generator(0, step, "growth"))
        growth = Growth(source, fresh, {"pulled": torch.zeros(len(source))})
        places[-2:] += moved
        return [(blobs, replace(growth, values={**growth.values, "places": places}))]

    def groups(self) -> list[Group]:
        blobs = self.blobs
        return [
            *super().groups(),
            Group("places", (blobs.places,), constant(1e-3)),
            Group("colours", (blobs.colours,), constant(1e-2)),
        ]
