"""Ev-DeblurNeRF: a sharp static radiance field from blurry frames and events.

M. Cannici and D. Scaramuzza, *Mitigating Motion Blur in Neural Radiance Fields with Events and
Frames*, CVPR 2024. Every pair of successive events of a pixel gives the change of log intensity
between two instants; every blurry pixel is a weighted mean of sharp light. Its weights are a kernel
learned for each image (the paper), or those of the known camera motion (`physical`).
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.core.measurements import Batch, EventPairs, Pixels, Terms
from sharpfield.core.protocols import Paper
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, Schedule, cosine, exponential, scaled
from sharpfield.core.tone import tone_of
from sharpfield.recipes.settings.presets import Presets, paper_of
from sharpfield.recipes.volume.learned_blur import KernelOptions, LearnedBlur, share_of_adaptive
from sharpfield.recipes.volume.scene import (
    DRAFT,
    GRID_RATE,
    STANDARD,
    FrameModel,
    Volume,
    VolumeOptions,
    stages,
)
from sharpfield.recipes.volume.terms import (
    EventOptions,
    EventTerm,
    FrameOptions,
    InstantsPrior,
    KernelTerm,
    MiddlePrior,
    MotionTerm,
    PriorOptions,
)

NETWORK_RATE = 5e-3
"""Learning rate of the networks beside a dense grid: the published one."""


def blender_full(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """The paper's numbers for its synthetic data."""
    return replace(
        recipe,
        tv_weight=1.0,
        frames=FrameOptions(),
        kernel=KernelOptions(),
        events=EventOptions(),
        prior=PriorOptions(),
    )


def blender_minus(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """Ev-DeblurNeRF-- of the paper: no EDI prior, gamma instead of a learned response."""
    return replace(
        blender_full(recipe), events=EventOptions(response="gamma"), prior=PriorOptions(weight=0.0)
    )


def cdavis_full(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """The paper's numbers for real data: colour events; frames count once blur is modelled."""
    return replace(
        blender_full(recipe),
        frames=FrameOptions(frames_from=1201),
        events=EventOptions(pairs=2048, threshold=(0.25, 0.25), half_pixel=False),
        prior=PriorOptions(weight=1.0, final_weight=1.0),
    )


def physical(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """Known camera motion instead of a learned kernel, EDI targets all along an exposure."""
    return replace(
        recipe,
        tv_weight=0.02,
        volume=replace(recipe.volume, noise=0.0, density="softplus"),
        frames=FrameOptions(blur="auto", blurred_pixels=256, blur_from=20_000),
        kernel=KernelOptions(integration="samples", norm="layer"),
        events=EventOptions(response="residual"),
        prior=PriorOptions(weight=1.0, final_weight=0.1, until=30_000, domain="linear"),
    )


def draft(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """Minutes on two CPU cores: a dense grid instead of feature volumes and networks."""
    recipe = recipe.lasting(2000)
    frames = recipe.frames
    frames = replace(
        frames,
        pixels=min(frames.pixels, 768),
        blurred_pixels=min(frames.blurred_pixels, 192),
        instants=min(frames.instants, 5),
        blur_from=min(frames.blur_from, 800),
    )
    return replace(
        recipe,
        lr=GRID_RATE,
        lr_decay_steps=1000,
        tv_weight=0.0,
        volume=replace(recipe.volume, **DRAFT),
        frames=frames,
        kernel=replace(recipe.kernel, lr=NETWORK_RATE),
        events=replace(recipe.events, pairs=512, weight=2 * recipe.events.weight, lr=NETWORK_RATE),
    )


def standard(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """Minutes on a GPU, hours on a CPU."""
    return replace(recipe.lasting(10_000), volume=replace(recipe.volume, **STANDARD))


def published(recipe: "EvDeblurNeRF") -> "EvDeblurNeRF":
    """The published size and length."""
    sizes = {name: getattr(VolumeOptions(), name) for name in STANDARD} | {"precision": "auto"}
    return replace(recipe.lasting(30_000), lr=5e-3, volume=replace(recipe.volume, **sizes))


def variant_for(capture: Capture, size: str) -> str:
    """`physical`, but at the size `paper` the published recipe for the capture's kind of sensor."""
    if size != "paper":
        return "physical"
    coloured = capture.events is not None and capture.events.coloured
    return "cdavis_full" if coloured else "blender_full"


@dataclass(frozen=True)
class EvDeblurNeRF:
    """A sharp static scene from blurry frames and events. Defaults: the paper's synthetic data."""

    paper: ClassVar[Paper] = paper_of("ev-deblur-nerf")
    renamed: ClassVar[dict[str, str]] = {
        "rate": "lr",
        "decay": "lr_decay_steps",
        "smooth": "tv_weight",
        "grids_faster": "grid_lr_factor",
        "kernel.rate": "kernel.lr",
        "kernel.trust": "kernel.adaptive_share",
        "kernel.trust_every": "kernel.adaptive_share_every",
        "events.rate": "events.lr",
        "prior.end": "prior.final_weight",
    }
    presets: ClassVar[Presets] = Presets(
        variants={
            "physical": physical,
            "blender_full": blender_full,
            "blender_minus": blender_minus,
            "cdavis_full": cdavis_full,
        },
        sizes={"draft": draft, "standard": standard, "paper": published},
        variant_for=variant_for,
    )

    steps: int = 30_000
    """Length of the schedule in steps."""
    lr: float = 5e-3
    """First learning rate of all parameters (Adam)."""
    grid_lr_factor: float = 1.0
    """Factor on the learning rate of planes and lines."""
    lr_decay_steps: int = 10_000
    """Steps in which the learning rate falls to a tenth."""
    tv_weight: float = 1.0
    """Weight of the total variation of planes and lines, or of the dense grid."""
    volume: VolumeOptions = field(default_factory=VolumeOptions)
    frames: FrameOptions = field(default_factory=FrameOptions)
    kernel: KernelOptions = field(default_factory=KernelOptions)
    events: EventOptions = field(default_factory=EventOptions)
    prior: PriorOptions = field(default_factory=PriorOptions)

    def lasting(self, steps: int) -> "EvDeblurNeRF":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""

        def stretched(number: int) -> int:
            return max(round(number * steps / self.steps), 1)

        frames, events = self.frames, self.events
        return replace(
            self,
            steps=steps,
            lr_decay_steps=stretched(self.lr_decay_steps),
            frames=replace(
                frames,
                blur_from=stretched(frames.blur_from),
                frames_from=stretched(frames.frames_from),
            ),
            kernel=replace(
                self.kernel, adaptive_share_every=stretched(self.kernel.adaptive_share_every)
            ),
            events=replace(
                events,
                response_from=stretched(events.response_from),
                colour_from=stretched(events.colour_from),
            ),
            prior=replace(self.prior, until=stretched(self.prior.until)),
        )

    def build(self, capture: Capture, seed: int) -> "Model":
        """The model of this recipe on one capture."""
        return Model(self, capture, seed)


class Model(FrameModel):
    """The model on one capture; terms of missing frames or events are left out."""

    def __init__(self, recipe: EvDeblurNeRF, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.seed = recipe, seed
        self.volume = Volume(recipe.volume, capture, seed)
        self.capture = self.volume.capture
        use_frames = capture.frames is not None and recipe.frames.pixels > 0
        use_events = capture.events is not None and recipe.events.weight > 0
        if not (use_frames or use_events):
            raise OptionError(
                "nothing is left to learn from",
                where=capture.name,
                got=f"frames.pixels {recipe.frames.pixels}, events.weight {recipe.events.weight}",
                do="use the capture's frames, or its events",
            )
        self.tone = tone_of(capture.frames.encoding if capture.frames else "linear")
        self.events = EventTerm(recipe.events, self.capture, seed) if use_events else None
        self.frames = self._frame_term() if use_frames else None
        self.lr = exponential(recipe.lr, recipe.lr / 10, begin=1, until=recipe.lr_decay_steps + 1)

    @property
    def heaviest_step(self) -> int:
        """The first step with several rays per pixel."""
        return self.recipe.frames.blur_from - 1 if self.frames is not None else 0

    def draw(self, step: int) -> Batch:
        """Random pixels of frames and random pairs of events."""
        batch: Batch = {}
        if self.frames is not None:
            batch["frames"] = self.frames.draw(step, self.volume.device)
        if self.events is not None:
            batch["events"] = self.events.draw(step, self.volume.device)
        return batch

    def losses(self, batch: Batch, step: int) -> Terms:
        """Blur, adaptive, prior and event terms, and the total variation."""
        terms: Terms = {}
        if self.frames is not None:
            assert isinstance(seen := batch["frames"], Pixels)
            terms |= self.frames.terms(self.volume, seen, step)
        if self.events is not None:
            assert isinstance(pairs := batch["events"], EventPairs)
            terms |= self._event_terms(self.events, pairs, step)
        if self.recipe.tv_weight > 0:
            terms["smooth"] = self.recipe.tv_weight * self.volume.smoothness()
        return terms

    def _event_terms(self, events: EventTerm, seen: EventPairs, step: int) -> Terms:
        sensor = events.sensor(step)
        light = self.volume.sharp(sensor.expose(seen), step, "events")
        errors = [events.error(sensor.observe(stage, seen), seen, step) for stage in stages(light)]
        terms = {"events": self.recipe.events.weight * torch.stack(errors).sum()}
        if (prior := events.prior()) is not None:
            terms["thresholds"] = self.recipe.events.weight * 1e-2 * prior
        return terms

    def render(self, rays: Rays) -> Radiance:
        """Sharp linear light along rays, without kernel or noise."""
        return self.volume.view(rays)

    def groups(self) -> list[Group]:
        """Parameters of networks, grids, kernel and response with their learning rates."""
        recipe = self.recipe

        def at(own: float | None) -> Schedule:
            return self.lr if own is None else scaled(self.lr, own / recipe.lr)

        groups = self.volume.groups(self.lr, scaled(self.lr, recipe.grid_lr_factor))
        if self.frames is not None and (kernel := tuple(self.frames.parameters())):
            groups.append(Group("kernel", kernel, at(recipe.kernel.lr)))
        if self.events is not None:
            groups += self.events.groups(at(recipe.events.lr))
        return groups

    def _frame_term(self) -> KernelTerm | MotionTerm:
        recipe, volume = self.recipe, self.volume
        prior, until = recipe.prior, recipe.prior.until
        weight = cosine(prior.weight, prior.final_weight, begin=0, until=until)
        known = self.capture.known.motion != "unknown"
        guess = (
            self.events.guess if self.events is not None and prior.weight > 0 and known else None
        )
        if recipe.frames.blur == "motion" or (recipe.frames.blur == "auto" and known):
            targets = None
            if guess is not None:
                targets = InstantsPrior(self.capture, guess, instants=recipe.frames.instants)
            return MotionTerm(recipe.frames, volume, self.tone.encode, weight, prior=targets)
        middle = None if guess is None else MiddlePrior(prior, self.capture, guess)
        blur = None
        if recipe.frames.blur != "none":
            blur = LearnedBlur(
                recipe.kernel,
                self.capture,
                self.tone.encode,
                features=volume.feature_width,
                seed=self.seed,
            )
        share = share_of_adaptive(recipe.kernel, begin=recipe.frames.blur_from, steps=recipe.steps)
        return KernelTerm(
            recipe.frames, volume, self.tone.encode, weight, blur=blur, share=share, prior=middle
        )
