"""Blur whose motion is learned for each image: the rigid kernel with adaptive weights."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Pixels
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Schedule
from sharpfield.core.seed import generator
from sharpfield.core.tone import Curve
from sharpfield.formation.adaptive import AdaptiveWeights, Integration, Norm
from sharpfield.formation.rigid_kernel import RigidKernel, RigidMotions
from sharpfield.losses.photometric import mse
from sharpfield.recipes.volume.scene import stages


@dataclass(frozen=True)
class KernelOptions:
    """The rigid blurring kernel of Ev-DeblurNeRF (CVPR 2024) and DP-NeRF (CVPR 2023)."""

    motions: int = 9
    """Learned rigid motions per image; the unmoved ray comes on top."""
    rate: float | None = None
    """First learning rate of kernel and adaptive network; None for that of everything."""
    adaptive: bool = True
    """A network proposes other weights for each pixel, from the features along its rays."""
    integration: Integration = "channels"
    """`channels` is the released rule of the adaptive network, `samples` the intended one."""
    norm: Norm = "batch"
    """Normalisation inside the adaptive network: batch (released) or layer."""
    trust: tuple[float, float] = (0.1, 0.9)
    """Share of the adaptive weights in the loss, when the kernel begins and at the end."""
    trust_every: int = 10_000
    """Iterations between updates of that share."""


def trust(options: KernelOptions, *, begin: int, steps: int) -> Schedule:
    """Share of the adaptive weights: geometric from begin to end, in the released staircase.

    A function of the iteration, which counts from 1.
    """
    first, last = options.trust

    def at(iteration: int) -> float:
        stair = iteration // options.trust_every * options.trust_every
        part = max(stair - begin, 0) / (steps + 1 - begin)
        return first * (last / first) ** part

    return at


class LearnedBlur(nn.Module):
    """Rays and losses of blurred pixels under a learned kernel."""

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

    def expose(self, seen: Pixels) -> Rays:
        """The origin and the moved rays."""
        return self.kernel.expose(seen)

    def losses(
        self, light: Radiance, seen: Pixels, *, trusted: float, rigid: bool
    ) -> dict[str, Float[Tensor, ""]]:
        """Errors under the rigid weights and under the adaptive ones.

        Args:
            light: Of the exposed rays, with samples if weights are adaptive.
            seen: What the frames say.
            trusted: Share of the adaptive weights.
            rigid: Whether the rigid term counts already.
        """
        terms: dict[str, Tensor] = {}
        if self.adaptive is None:
            trusted = 0.0
        if rigid:
            terms["blur"] = (1 - trusted) * self._error(light, seen)
        if self.adaptive is not None and light.samples is not None:
            weight = self.adaptive(light.samples, self.motions.codes(seen.frame))
            mixed = Radiance(light.rgb, light.depth, light.opacity, weight)
            terms["adaptive"] = trusted * mse(self.kernel.observe(mixed, seen), seen.value)
        return terms

    def _error(self, light: Radiance, seen: Pixels) -> Float[Tensor, ""]:
        errors = [mse(self.kernel.observe(stage, seen), seen.value) for stage in stages(light)]
        return torch.stack(errors).sum()
