"""Terms of the volume recipes: of frames, of the EDI prior, and of pairs of events.

Frames are blurred by a learned kernel, or along the known motion. The EDI prior has sharp images
from the event double integral as targets of single rays. Events have a response and the contrast
error.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import EventPairs, Pixels, Terms
from sharpfield.core.protocols import Response
from sharpfield.core.rays import Radiance
from sharpfield.core.schedule import Group, Schedule
from sharpfield.core.seed import generator
from sharpfield.core.tone import Curve, gamma, tone_of
from sharpfield.events.counts import EventMotion
from sharpfield.events.double_integral import latent_in_light, published
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds, thresholds_of
from sharpfield.formation.events import LogContrast
from sharpfield.formation.response import FixedResponse, LearnedResponse, LogResidual
from sharpfield.formation.shutter import Pinhole, Shutter, expose_at
from sharpfield.losses.events import BAYER_WEIGHTS, contrast_error
from sharpfield.losses.photometric import mse
from sharpfield.recipes.volume.learned_blur import LearnedBlur
from sharpfield.recipes.volume.scene import Volume, stages
from sharpfield.sampling.pixels_and_pairs import (
    PairTable,
    draw_pairs,
    draw_pixels,
    pair_table,
    pixel_table,
)
from sharpfield.storage.event_cache import event_index


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
                self.blur.kernel.expose(seen),
                step,
                "frames",
                samples=self.blur.adaptive is not None,
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


@dataclass(frozen=True)
class EventOptions:
    """The event loss. Defaults: Ev-DeblurNeRF's synthetic recipe."""

    weight: float = 0.1
    """Weight of the event loss; 0 leaves events out."""
    pairs: int = 4096
    """Pairs of successive events per step."""
    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter, natural log; None takes that of the capture,
    or 0.2."""
    lr: float | None = None
    """First learning rate of response and thresholds; None takes `lr`."""
    learn_threshold: bool = False
    """Learn one threshold for each polarity; needs frames, as events leave their scale open."""
    response: Literal["linear", "gamma", "learned", "residual"] = "learned"
    """Response of event pixels, before the logarithm: `linear` light; `gamma`, display values;
    `learned`, the published curve (sigmoid of light plus a network); `residual`, log light plus a
    learned function of it that starts at zero."""
    polarity: bool = True
    """Whether a learned response also takes the polarities of the pair as inputs."""
    response_from: int = 1200
    """Iteration from which a learned response is used; linear light before."""
    colour: bool = True
    """Whether events behind a colour filter are compared with their own channel; else with luma."""
    colour_from: int = 1200
    """Iteration after which the channels are weighted 0.4, 0.2, 0.4."""
    accumulate: tuple[int, int] = (0, 0)
    """Least and largest number of events that a pair spans; (0, 0) takes successive events."""
    half_pixel: bool = True
    """Whether rectified positions are measured from pixel centres; the released code measures from
    corners."""


class EventTerm(nn.Module):
    """Pairs of events, the response of the event camera, and the contrast error."""

    def __init__(self, options: EventOptions, capture: Capture, seed: int) -> None:
        super().__init__()
        self.options, self.seed = options, seed
        events = capture.needed_events
        self.table: PairTable = pair_table(
            capture,
            event_index(events),
            successors=max(options.accumulate[0], 0) + 1,
            half_pixel=options.half_pixel,
        )
        self.coloured = options.colour and events.coloured
        inputs = "light+polarity" if options.polarity else "light"
        self.learned: nn.Module | None = None
        if options.response == "learned":
            self.learned = LearnedResponse(inputs=inputs)
        elif options.response == "residual":
            self.learned = LogResidual(inputs=inputs, generator=generator(seed, 0, "response"))
        fixed = FixedResponse(gamma) if options.response == "gamma" else FixedResponse()
        self.early: Response = fixed
        self.camera, self.path = capture.camera, capture.trajectory
        self.guess = thresholds_of(capture, options.threshold)
        kind = LearnedThresholds if options.learn_threshold else FixedThresholds
        self.thresholds = kind(*self.guess)

    def draw(self, step: int, device: torch.device) -> EventPairs:
        """Random pairs of events of a step."""
        seen = draw_pairs(
            self.table,
            self.options.pairs,
            seed=self.seed,
            step=step,
            accumulate=self.options.accumulate,
            device=device,
        )
        return seen if self.coloured else replace(seen, channel=None)

    def sensor(self, step: int) -> LogContrast:
        """The event sensor with the response of a step."""
        late = self.learned is not None and step + 1 >= self.options.response_from
        response = self.learned if late and self.learned is not None else self.early
        return LogContrast(self.camera, self.path, response)

    def error(
        self, predicted: Float[Tensor, "b 1"], seen: EventPairs, step: int
    ) -> Float[Tensor, ""]:
        """Mean squared error of the change of log intensity (Ev-DeblurNeRF, event loss)."""
        weigh = self.coloured and step + 1 > self.options.colour_from
        return contrast_error(
            predicted,
            seen.measured(*self.thresholds(seen)),
            channel=seen.channel,
            weights=BAYER_WEIGHTS if weigh else None,
        )

    def prior(self) -> Float[Tensor, ""] | None:
        """Penalty of learned thresholds far from their first values; None if they are fixed."""
        return self.thresholds.prior() if isinstance(self.thresholds, LearnedThresholds) else None

    def groups(self, rate: Schedule) -> list[Group]:
        """Parameters of response and thresholds with their learning rate."""
        return [Group("response", own, rate)] if (own := tuple(self.parameters())) else []
