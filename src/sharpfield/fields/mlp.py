"""The field of NeRF: two large MLPs of position and direction, without a feature lookup.

Source: NeRF (ECCV 2020), appendix A.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.ops.dense import Dense, SplitLinear, linear
from sharpfield.ops.encoding import frequencies, frequencies_width


class MLPHead(nn.Module):
    """Eight wide layers with a skip, then a short branch with the direction as input.

    Args:
        width: Of the layers; 256 in the paper.
        depth: Number of layers; the input is concatenated again after half of them.
        generator: Where the first parameters come from.
        position: Octaves of the position's encoding.
        direction: Octaves of the direction's encoding.
        colours: 3, or 1 for grey.
    """

    def __init__(
        self,
        *,
        generator: torch.Generator,
        width: int = 256,
        depth: int = 8,
        position: int = 10,
        direction: int = 4,
        colours: int = 3,
    ) -> None:
        super().__init__()
        self.position, self.direction = position, direction
        sizes = [frequencies_width(3, position), *([width] * depth)]
        self.trunk = Dense(sizes, generator=generator, skips=(depth // 2 + 1,))
        self.to_density = linear(width, 1, generator=generator)
        self.to_feature = linear(width, width, generator=generator)
        self.first = SplitLinear(
            width, frequencies_width(3, direction), width // 2, generator=generator
        )
        self.last = linear(width // 2, colours, generator=generator)

    def density(
        self, features: Float[Tensor, "*b s f"], points: Float[Tensor, "*b s 3"]
    ) -> tuple[Float[Tensor, "*b s"], Float[Tensor, "*b s h"]]:
        """Density before its activation, and the features of the trunk."""
        hidden = torch.relu(self.trunk(frequencies(points, self.position)))
        return self.to_density(hidden)[..., 0], hidden

    def feature(self, hidden: Float[Tensor, "*b s h"]) -> Float[Tensor, "*b s h"]:
        """Those of the trunk."""
        return hidden

    def colour(
        self, feature: Float[Tensor, "*b s h"], direction: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b s c"]:
        """Linear colour, 0...1."""
        ray = frequencies(direction, self.direction)
        seen = torch.relu(self.first(self.to_feature(feature), ray))
        return torch.sigmoid(self.last(seen))


class MLPField(nn.Module):
    """A coarse and a fine network of the same shape, as in NeRF.

    Args:
        generator: Where the first parameters come from.
        width: Of the layers.
        depth: Number of layers.
        colours: 3, or 1 for grey.
        networks: 2, or 1 that is both coarse and fine.
    """

    def __init__(
        self,
        *,
        generator: torch.Generator,
        width: int = 256,
        depth: int = 8,
        colours: int = 3,
        networks: int = 2,
    ) -> None:
        super().__init__()
        heads = [
            MLPHead(generator=generator, width=width, depth=depth, colours=colours)
            for _ in range(networks)
        ]
        self.coarse, self.fine = heads[0], heads[-1]

    def coarse_features(
        self, points: Float[Tensor, "*b s 3"], time: Float[Tensor, "*b"]
    ) -> Float[Tensor, "*b s 0"]:
        """Nothing: the networks read the position itself."""
        return points[..., :0]

    def fine_features(
        self,
        features: Float[Tensor, "*b s 0"],
        old: Float[Tensor, "*b s 3"],
        new: Float[Tensor, "*b m 3"],
        time: Float[Tensor, "*b"],
    ) -> Float[Tensor, "*b t 0"]:
        """Nothing."""
        return torch.cat([old, new], -2)[..., :0]
