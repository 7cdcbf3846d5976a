"""A deformable field: points at a time are mapped to a static canonical field.

A *deformation* gives the offset of a point at a time to its position in the *canonical* scene.
`Warped` evaluates a static field there, so that any field can represent a moving scene.

Source: D-NeRF (CVPR 2021), section 3, whose networks EvDNeRF (WACV 2024) keeps.
"""

from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.protocols import Field, Head
from sharpfield.ops.dense import Dense
from sharpfield.ops.encoding import frequencies, frequencies_width

AtZero = Literal["exactly", "smoothly"]
"""How the time-zero constraint holds: deformation is set to zero at that very instant, and jumps
after it (published); or it is multiplied by time."""

HALF = 5
"""Layers of the published network before the position is concatenated again."""


@runtime_checkable
class Motion(Protocol):
    """A deformation of points over time."""

    def __call__(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s 3"]:
        """Offsets from points of each ray to the canonical scene."""
        ...


class Deformation(nn.Module):
    """The network of D-NeRF: eight wide layers of position and time, with a skip of the position.

    Args:
        generator: Where the first parameters come from.
        width: Of the layers.
        depth: Number of layers; more than `HALF`.
        position: Octaves of the position's encoding.
        moment: Octaves of the time's encoding.
        at_zero: How the canonical scene is that of time 0.
    """

    def __init__(
        self,
        *,
        generator: torch.Generator,
        width: int = 256,
        depth: int = 8,
        position: int = 10,
        moment: int = 10,
        at_zero: AtZero = "exactly",
    ) -> None:
        super().__init__()
        assert depth > HALF, f"the skip is after {HALF} layers, there are {depth}"
        self.position, self.moment, self.at_zero = position, moment, at_zero
        inputs = frequencies_width(3, position)
        first = [inputs + frequencies_width(1, moment), *([width] * HALF)]
        self.before = Dense(first, generator=generator)
        self.after = Dense([inputs + width, *([width] * (depth - HALF)), 3], generator=generator)

    def forward(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s 3"]:
        """Offsets of points."""
        position = frequencies(points, self.position)
        moment = frequencies(time[..., None], self.moment)[..., None, :]
        moment = moment.expand(*position.shape[:-1], moment.shape[-1])
        hidden = torch.relu(self.before(torch.cat([position, moment], -1)))
        offset = self.after(torch.cat([position, hidden], -1))
        factor = time if self.at_zero == "smoothly" else (time != 0).to(time.dtype)
        return offset * factor[..., None, None]


class _WarpedHead(nn.Module):
    """A head at canonical points, which are the first three of the features."""

    def __init__(self, head: Head) -> None:
        super().__init__()
        self.head = head

    def density(
        self, features: Float[Tensor, "*b s f"], points: Float[Tensor, "*b s 3"]
    ) -> tuple[Float[Tensor, "*b s"], Float[Tensor, "*b s h"]]:
        """Of the canonical scene; the points themselves do not matter."""
        return self.head.density(features[..., 3:], features[..., :3])

    def feature(self, hidden: Float[Tensor, "*b s h"]) -> Float[Tensor, "*b s g"]:
        """Of the canonical scene."""
        return self.head.feature(hidden)

    def colour(
        self, feature: Float[Tensor, "*b s g"], direction: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b s c"]:
        """Of the canonical scene; the direction is not rotated."""
        return self.head.colour(feature, direction)


class Warped(nn.Module):
    """A static field with a deformation.

    Args:
        field: The canonical scene.
        deformation: From a time to it.
    """

    def __init__(self, field: Field, deformation: Motion) -> None:
        super().__init__()
        self.field, self.deformation = field, deformation
        self.coarse = _WarpedHead(field.coarse)
        self.fine = _WarpedHead(field.fine)

    def coarse_features(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s f"]:
        """Canonical points, and the field's features there."""
        moved = points + self.deformation(points, time)
        return torch.cat([moved, self.field.coarse_features(moved, time)], -1)

    def fine_features(
        self,
        features: Float[Tensor, "*b s f"],
        old: Float[Tensor, "*b s 3"],
        new: Float[Tensor, "*b m 3"],
        time: Float[Tensor, "*b"],
    ) -> Float[Tensor, "*b t g"]:
        """The same for the fine stage; the old points are already canonical."""
        back = features[..., :3]
        moved = new + self.deformation(new, time)
        found = self.field.fine_features(features[..., 3:], back, moved, time)
        return torch.cat([torch.cat([back, moved], -2), found], -1)
