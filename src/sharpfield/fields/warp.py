"""A field that moves: points are carried back to where they were at the first instant.

A *deformation* says how far a point at a time is from its place in the *canonical* scene, which
stands still. `Warped` looks there instead, so that any still field becomes one of a moving scene.

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
"""Layers of the published network before the position is seen again."""


@runtime_checkable
class Motion(Protocol):
    """Where points have moved from."""

    def __call__(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s 3"]:
        """What to add to points of each ray to be in the canonical scene."""
        ...


class Deformation(nn.Module):
    """The network of D-NeRF: eight wide layers of position and time, position seen again.

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
        assert depth > HALF, f"the position is seen again after {HALF} layers, not {depth}"
        self.position, self.moment, self.at_zero = position, moment, at_zero
        seen = frequencies_width(3, position)
        first = [seen + frequencies_width(1, moment), *([width] * HALF)]
        self.before = Dense(first, generator=generator)
        self.after = Dense([seen + width, *([width] * (depth - HALF)), 3], generator=generator)

    def forward(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s 3"]:
        """What to add to points."""
        place = frequencies(points, self.position)
        when = frequencies(time[..., None], self.moment)[..., None, :]
        when = when.expand(*place.shape[:-1], when.shape[-1])
        hidden = torch.relu(self.before(torch.cat([place, when], -1)))
        moved = self.after(torch.cat([place, hidden], -1))
        share = time if self.at_zero == "smoothly" else (time != 0).to(time.dtype)
        return moved * share[..., None, None]


class _WarpedHead(nn.Module):
    """A head at canonical points, which come with what was looked up there."""

    def __init__(self, head: Head) -> None:
        super().__init__()
        self.head = head

    def density(
        self, looked: Float[Tensor, "*b s f"], points: Float[Tensor, "*b s 3"]
    ) -> tuple[Float[Tensor, "*b s"], Float[Tensor, "*b s h"]]:
        """Of the canonical scene; the points themselves do not matter."""
        return self.head.density(looked[..., 3:], looked[..., :3])

    def feature(self, hidden: Float[Tensor, "*b s h"]) -> Float[Tensor, "*b s g"]:
        """Of the canonical scene."""
        return self.head.feature(hidden)

    def colour(
        self, feature: Float[Tensor, "*b s g"], direction: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b s c"]:
        """Of the canonical scene; the direction is not turned."""
        return self.head.colour(feature, direction)


class Warped(nn.Module):
    """A still field, made to move.

    Args:
        field: The canonical scene.
        deformation: From a moment to it.
    """

    def __init__(self, field: Field, deformation: Motion) -> None:
        super().__init__()
        self.field, self.deformation = field, deformation
        self.coarse = _WarpedHead(field.coarse)
        self.fine = _WarpedHead(field.fine)

    def look(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s f"]:
        """Canonical points, and what the field finds there."""
        moved = points + self.deformation(points, time)
        return torch.cat([moved, self.field.look(moved, time)], -1)

    def look_closer(
        self,
        looked: Float[Tensor, "*b s f"],
        old: Float[Tensor, "*b s 3"],
        new: Float[Tensor, "*b m 3"],
        time: Float[Tensor, "*b"],
    ) -> Float[Tensor, "*b t g"]:
        """The same closely; old points were carried back before."""
        back = looked[..., :3]
        moved = new + self.deformation(new, time)
        found = self.field.look_closer(looked[..., 3:], back, moved, time)
        return torch.cat([torch.cat([back, moved], -2), found], -1)
