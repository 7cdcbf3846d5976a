"""The frame terms of the volume recipes: learned blur kernels, or blur along the known motion.

The EDI prior: sharp images from the event double integral as targets of single rays.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Pixels
from sharpfield.core.rays import Radiance
from sharpfield.core.schedule import Schedule
from sharpfield.core.seed import generator
from sharpfield.core.tone import Curve, tone_of
from sharpfield.events.double_integral import latent_in_light, published
from sharpfield.events.motion import EventMotion
from sharpfield.events.threshold import FixedThresholds
from sharpfield.formation.shutter import Pinhole, Shutter, expose_at
from sharpfield.losses.photometric import mse
from sharpfield.recipes.volume.learned_blur import LearnedBlur
from sharpfield.recipes.volume.scene import Volume, stages
from sharpfield.sampling.pixels_and_pairs import draw_pixels, pixel_table


@dataclass(frozen=True)
class PriorOptions:
    """The EDI prior. Defaults: Ev-DeblurNeRF's synthetic recipe."""

    weight: float = 0.01
    """Weight of the prior at the first step; 0 leaves it out."""
    final_weight: float = 1e-5
    """Weight of the prior from step `until` on."""
    until: int = 10_000
    """Step until which the weight falls along half a cosine."""
    domain: Literal["display", "linear"] = "display"
    """What the event double integral averages: stored values in eight slices (`display`, as
    released), or linear light."""


class MiddlePrior(nn.Module):
    """EDI images of each frame at the middle of its exposure, as published."""

    images: Tensor

    def __init__(
        self, options: PriorOptions, capture: Capture, threshold: tuple[float, float]
    ) -> None:
        super().__init__()
        frames, thresholds = capture.needed_frames, FixedThresholds(*threshold)
        tone, linear = tone_of(frames.encoding), options.domain == "linear"
        motion = EventMotion.of(capture) if linear else None
        images = torch.zeros(frames.images.shape)
        for i in capture.split.train:
            stored = torch.from_numpy(frames.images[i].astype(np.float32)) / frames.white
            window = frames.exposure.window(int(i))
            if motion is not None:
                middle = frames.exposure.middle_us[i : i + 1]
                path = motion.path(window, middle, thresholds)
                images[i] = latent_in_light(stored, path, 0, tone)
            else:
                images[i] = published(stored, capture.needed_events, window, thresholds)
        self.register_buffer("images", images, persistent=False)

    def target(self, seen: Pixels) -> Float[Tensor, "b c"]:
        """Stored values of sharp pixels; the published ones are not clipped."""
        x, y = seen.xy.long().unbind(-1)
        return self.images[seen.frame, y, x]


class InstantsPrior(nn.Module):
    """EDI images at several instants of each exposure, exact and in linear light."""

    ratio: Tensor

    def __init__(self, capture: Capture, threshold: tuple[float, float], *, instants: int) -> None:
        super().__init__()
        frames, thresholds = capture.needed_frames, FixedThresholds(*threshold)
        motion = EventMotion.of(capture)
        channels = 1 if motion.channel is None else frames.channels
        size = (len(frames), instants, frames.height, frames.width, channels)
        ratio = torch.ones(size, dtype=torch.half)
        part = (np.arange(instants) + 0.5) / instants
        for i in capture.split.train:
            opens, closes = window = frames.exposure.window(int(i))
            middles = opens + np.rint((closes - opens) * part).astype(np.int64)
            path = motion.path(window, middles, thresholds)
            ratio[i] = (path.change - path.log_mean).exp().half()
        self.register_buffer("ratio", ratio, persistent=False)
        self.tone = tone_of(frames.encoding)

    def target(self, seen: Pixels) -> Float[Tensor, "b k c"]:
        """Stored values of sharp pixels at each instant."""
        x, y = seen.xy.long().unbind(-1)
        ratio = self.ratio[seen.frame, :, y, x].float()
        light = self.tone.decode(seen.value)[:, None] * ratio
        return self.tone.encode(light.clamp(0, 1))


Terms = dict[str, Tensor]


@dataclass(frozen=True)
class FrameOptions:
    """The frame losses. Defaults: Ev-DeblurNeRF's synthetic recipe."""

    blur: Literal["kernel", "motion", "none", "auto"] = "kernel"
    """Model of blur: `kernel`, learned for each image; `motion`, the mean along the known camera
    motion; `none`; `auto` takes `motion` where it is known, else `kernel`."""
    pixels: int = 1024
    """Pixels per step with a single ray each; 0 leaves frames out."""
    blurred_pixels: int = 1024
    """Pixels per step once each has several rays."""
    instants: int = 9
    """Instants of an exposure that are averaged, with `motion`."""
    blur_from: int = 1200
    """Iteration from which blur is modelled."""
    frames_from: int = 1
    """Iteration from which the loss of frames counts; without a prior from the first."""


class FrameTerm(nn.Module):
    """What all frame terms share: random pixels, and their rays.

    Args:
        options: Numbers of pixels, and first iterations.
        volume: The static scene.
        tone: Linear light to stored values.
        prior_weight: Weight of the EDI prior by step.
    """

    def __init__(
        self, options: FrameOptions, volume: Volume, tone: Curve, prior_weight: Schedule
    ) -> None:
        super().__init__()
        self.options, self.tone, self.prior_weight = options, tone, prior_weight
        self.seed = volume.seed
        self.table = pixel_table(volume.capture)
        self.pinhole = Pinhole(volume.capture.camera, volume.capture.trajectory, tone)

    def blurred(self, step: int) -> bool:
        """Whether this step models blur."""
        return self.options.blur != "none" and step + 1 >= self.options.blur_from

    def draw(self, step: int, device: torch.device) -> Pixels:
        """Random pixels of a step."""
        options = self.options
        count = options.blurred_pixels if self.blurred(step) else options.pixels
        return draw_pixels(self.table, count, seed=self.seed, step=step, device=device)

    def stored_error(self, light: Radiance, target: Float[Tensor, "*b c"]) -> Float[Tensor, ""]:
        """Mean squared error of the stored value of each ray, fine and coarse."""
        return torch.stack([mse(self.tone(stage.rgb), target) for stage in stages(light)]).sum()


class KernelTerm(FrameTerm):
    """Kernels learned for each image, as published: single rays first, then the kernel."""

    def __init__(
        self,
        options: FrameOptions,
        volume: Volume,
        tone: Curve,
        prior_weight: Schedule,
        *,
        blur: LearnedBlur | None,
        share: Schedule,
        prior: MiddlePrior | None,
    ) -> None:
        super().__init__(options, volume, tone, prior_weight)
        self.blur, self.share, self.prior = blur, share, prior
        self.frames_from = options.frames_from if prior is not None else 1

    def terms(self, volume: Volume, seen: Pixels, step: int) -> Terms:
        """Squared errors of blurred pixels, and of their unmoved rays against the EDI prior."""
        iteration = step + 1
        counts = iteration >= self.frames_from
        if self.blur is None or not self.blurred(step):
            light = volume.sharp(self.pinhole.expose(seen), step, "frames")
            terms = {"blur": self.stored_error(light[:, 0], seen.value)} if counts else {}
        else:
            light = volume.sharp(
                self.blur.expose(seen), step, "frames", samples=self.blur.adaptive is not None
            )
            terms = self.blur.losses(light, seen, share=self.share(iteration), rigid=counts)
        if self.prior is not None:
            error = self.stored_error(light[:, 0], self.prior.target(seen))
            terms["prior"] = self.prior_weight(step) * error
        return terms


class MotionTerm(FrameTerm):
    """Blur as the mean along the known motion, with EDI targets at every instant.

    Before blur is modelled, each pixel is rendered at one random instant of its exposure, a single
    ray, and compared with the EDI image of that instant.
    """

    def __init__(
        self,
        options: FrameOptions,
        volume: Volume,
        tone: Curve,
        prior_weight: Schedule,
        *,
        prior: InstantsPrior | None,
    ) -> None:
        super().__init__(options, volume, tone, prior_weight)
        capture = volume.capture
        self.prior = prior
        self.shutter = Shutter(capture.camera, capture.trajectory, options.instants, tone)

    def blurred(self, step: int) -> bool:
        """Whether this step models blur; without EDI images always."""
        return self.prior is None or super().blurred(step)

    def terms(self, volume: Volume, seen: Pixels, step: int) -> Terms:
        """Error of the blurred pixels, and of all rays against the sharp images."""
        if not self.blurred(step):
            return self._early(volume, seen, step)
        light = volume.sharp(self.shutter.expose(seen), step, "frames")
        errors = [mse(self.shutter.observe(stage, seen), seen.value) for stage in stages(light)]
        terms = {"blur": torch.stack(errors).sum()}
        if self.prior is not None:
            error = self.stored_error(light, self.prior.target(seen))
            terms["prior"] = self.prior_weight(step) * error
        return terms

    def _early(self, volume: Volume, seen: Pixels, step: int) -> Terms:
        assert self.prior is not None
        made = generator(self.seed, step, "instant", seen.device)
        which = torch.randint(
            self.shutter.samples, (len(seen),), generator=made, device=seen.device
        )
        part = (which + 0.5) / self.shutter.samples
        time = seen.open + (seen.close - seen.open) * part
        pinhole = self.pinhole
        rays = expose_at(pinhole.camera, pinhole.trajectory, seen, time[:, None])
        light = volume.sharp(rays, step, "frames")
        target = self.prior.target(seen)[torch.arange(len(seen)), which]
        return {"prior": self.prior_weight(step) * self.stored_error(light[:, 0], target)}
