"""Learned blur kernels: rigid motions for each image, with adaptive weights for each pixel."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Pixels
from sharpfield.core.rays import Radiance
from sharpfield.core.schedule import Schedule
from sharpfield.core.seed import generator
from sharpfield.core.tone import Curve
from sharpfield.formation.adaptive import AdaptiveWeights, Integration, Norm
from sharpfield.formation.ray_kernels import RigidKernel, RigidMotions
from sharpfield.losses.photometric import mse
from sharpfield.recipes.volume.scene import stages


@dataclass(frozen=True)
class KernelOptions:
    """The rigid blurring kernel of Ev-DeblurNeRF (CVPR 2024) and DP-NeRF (CVPR 2023)."""

    motions: int = 9
    """Learned rigid motions per image, besides the unmoved ray."""
    lr: float | None = None
    """First learning rate of kernel and adaptive network; None takes `lr`."""
    adaptive: bool = True
    """Whether a network predicts weights for each pixel from the features along its rays."""
    integration: Integration = "channels"
    """Integration of features by the adaptive network: over `channels`, as released, or over
    `samples`, as intended."""
    norm: Norm = "batch"
    """Normalisation in the adaptive network: batch (released) or layer."""
    adaptive_share: tuple[float, float] = (0.1, 0.9)
    """Share of the adaptive weights in the loss at the first blurred iteration and at the end."""
    adaptive_share_every: int = 10_000
    """Iterations between updates of that share."""


def share_of_adaptive(options: KernelOptions, *, begin: int, steps: int) -> Schedule:
    """Schedule of the share of adaptive weights: geometric, in the released staircase.

    A function of the iteration, which counts from 1.
    """
    first, last = options.adaptive_share

    def at(iteration: int) -> float:
        stair = iteration // options.adaptive_share_every * options.adaptive_share_every
        part = max(stair - begin, 0) / (steps + 1 - begin)
        return first * (last / first) ** part

    return at


class LearnedBlur(nn.Module):
    """Rays and losses of blurred pixels with a learned kernel."""

    def __init__(
        self, options: KernelOptions, capture: Capture, tone: Curve, *, features: int, seed: int
    ) -> None:
        super().__init__()
        made = generator(seed, 0, "kernel")
        count = len(capture.needed_frames)
        self.motions = RigidMotions(count, motions=options.motions, generator=made)
        self.kernel = RigidKernel(capture.camera, capture.trajectory, self.motions, tone)
        self.adaptive = (
            AdaptiveWeights(
                self.motions.rays,
                features=features,
                integration=options.integration,
                norm=options.norm,
                generator=made,
            )
            if options.adaptive and features
            else None
        )

    def losses(
        self, light: Radiance, seen: Pixels, *, share: float, rigid: bool
    ) -> dict[str, Float[Tensor, ""]]:
        """Squared errors with the rigid weights and with the adaptive ones.

        Args:
            light: Radiance of the exposed rays, with samples if weights are adaptive.
            seen: Pixels of the frames.
            share: Share of the adaptive weights in the loss.
            rigid: Whether the rigid term is part of the loss yet.
        """
        terms: dict[str, Tensor] = {}
        if self.adaptive is None:
            share = 0.0
        if rigid:
            errors = [mse(self.kernel.observe(stage, seen), seen.value) for stage in stages(light)]
            terms["blur"] = (1 - share) * torch.stack(errors).sum()
        if self.adaptive is not None and light.samples is not None:
            weight = self.adaptive(light.samples, self.motions.codes(seen.frame))
            mixed = Radiance(light.rgb, light.depth, light.opacity, weight)
            terms["adaptive"] = share * mse(self.kernel.observe(mixed, seen), seen.value)
        return terms
