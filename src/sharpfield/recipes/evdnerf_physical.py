"""EvDNeRF made physical: a moving scene from events of several views, and frames if there are any.

It asks the same of a scene as A. Bhattacharya et al., *EvDNeRF: Reconstructing Event Data with
Dynamic Neural Radiance Fields*, WACV 2024, but keeps to what an event says. Density is unbounded
and the background the same at all times; both instants of a window are seen at the same points, so
that what stands still makes no event at all; events are counted exactly in windows of any length,
at full resolution. Windows that end with events of their pixel are exact; others say as much as
their counts do, up to a threshold.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, EventPairs, Pixels
from sharpfield.core.paper import Paper
from sharpfield.core.rays import Radiance, Rays
from sharpfield.core.schedule import Group, exponential
from sharpfield.core.tone import luma, tone_of
from sharpfield.events.threshold import FixedThresholds, LearnedThresholds, thresholds_of
from sharpfield.fields.voxels import VoxelSizes
from sharpfield.formation.events import LogContrast
from sharpfield.formation.response import FixedResponse
from sharpfield.formation.shutter import Shutter
from sharpfield.losses.events import counted_error, exact_error
from sharpfield.losses.photometric import mse
from sharpfield.recipes import evdnerf
from sharpfield.recipes.settings.presets import Presets
from sharpfield.recipes.volume.frame_terms import Terms
from sharpfield.recipes.volume.voxel_scene import MovingOptions, MovingScene
from sharpfield.sampling.pixels_and_pairs import draw_pixels, pair_table, pixel_table
from sharpfield.sampling.windows import Lengths, draw_spans, draw_windows
from sharpfield.storage.event_cache import event_index

PAPER = replace(
    evdnerf.PAPER, key="sharpfield-evdnerf-physical", title="EvDNeRF made physical", departures=()
)


@dataclass(frozen=True)
class WindowOptions:
    """Which windows of events are looked at, and how far each is trusted."""

    spans: int = 128
    """Windows drawn per step that begin and end with an event."""
    counted: int = 640
    """Other windows drawn per step."""
    busy: float = 0.5
    """Share of these that hold an event for certain; the others are of any pixel."""
    lengths: Lengths = Lengths(shortest=1 / 8)
    """Long ones tell most: one end often sees what stands still. Spans may be short."""
    pull: float = 0.2
    """How much of the difference counts where it may be what is left over."""
    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter; None takes what the capture notes, or 0.2."""
    learn_threshold: bool = False
    """Refine one threshold for each sign (with frames: events alone cannot tell their size)."""
    learn_late: bool = False
    """Learn by how much the clock of each camera is late against the mean of all."""
    late_rate_us: float = 100.0
    """First learning rate of that."""
    floor: float = 1e-5
    """Light added before the logarithm, where the capture does not note it."""


def draft(recipe: "EvDNeRFPhysical") -> "EvDNeRFPhysical":
    """Minutes on two CPU cores."""
    windows = replace(recipe.windows, spans=64, counted=320)
    return replace(recipe.lasting(2000), windows=windows)


def standard(recipe: "EvDNeRFPhysical") -> "EvDNeRFPhysical":
    """Finer in space and time; an hour on a CPU."""
    size = VoxelSizes(static=96, moving=80, moments=48)
    scene = replace(recipe.scene, size=size, steps=96)
    windows = replace(recipe.windows, spans=256, counted=1280)
    return replace(recipe.lasting(12_000), scene=scene, windows=windows)


@dataclass(frozen=True)
class EvDNeRFPhysical:
    """Events of a moving scene, counted exactly, and frames if there are any."""

    paper: ClassVar[Paper] = PAPER
    presets: ClassVar[Presets] = Presets(sizes={"draft": draft, "standard": standard})

    steps: int = 6000
    """Length of the schedule."""
    rate: float = 0.1
    """First learning rate of voxels."""
    decay: int = 6000
    """Steps in which it falls to a tenth."""
    scene: MovingOptions = field(default_factory=MovingOptions)
    windows: WindowOptions = field(default_factory=WindowOptions)
    pixels: int = 512
    """Pixels of frames drawn per step, if there are frames."""
    instants: int = 3
    """Instants of an exposure that lasts."""
    frames: float = 500.0
    """Weight of the frames."""

    def lasting(self, steps: int) -> "EvDNeRFPhysical":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(self, steps=steps, decay=max(round(self.decay * steps / self.steps), 1))

    def build(self, capture: Capture, seed: int) -> "Model":
        """The recipe on one capture."""
        return Model(self, capture, seed)


class Model(nn.Module):
    """A moving scene, and the events and frames it explains."""

    heaviest_step = 0

    def __init__(self, recipe: EvDNeRFPhysical, capture: Capture, seed: int) -> None:
        super().__init__()
        self.recipe, self.seed = recipe, seed
        index = event_index(capture.needed_events)
        self.scene = MovingScene(recipe.scene, capture, seed, index)
        self.capture = self.scene.capture
        self.tone = tone_of(capture.frames.encoding if capture.frames else "linear")
        self.table = pair_table(self.capture, index)
        camera, path = self.capture.camera, self.capture.trajectory
        floor = capture.known.log_floor
        self.floor = recipe.windows.floor if floor is None else floor
        self.sensor = LogContrast(camera, path, FixedResponse(floor=self.floor))
        kind = LearnedThresholds if recipe.windows.learn_threshold else FixedThresholds
        self.thresholds = kind(*thresholds_of(capture, recipe.windows.threshold))
        unknown = recipe.windows.learn_late
        self.late = nn.Parameter(torch.zeros(index.tracks)) if unknown else None
        """Of each track, in shares of the capture."""
        use_frames = capture.frames is not None and recipe.pixels > 0
        self.pixels = pixel_table(self.capture) if use_frames else None
        blurred = capture.frames is not None and not capture.frames.exposure.instant.all()
        instants = recipe.instants if blurred else 1
        self.shutter = Shutter(camera, path, instants, self.tone.encode)
        self.rate = exponential(recipe.rate, recipe.rate / 10, until=recipe.decay)

    def draw(self, step: int) -> Batch:
        """Spans and windows of events, and pixels of frames."""
        options, device = self.recipe.windows, self.scene.device
        batch: Batch = {
            "spans": draw_spans(
                self.table, options.spans, seed=self.seed, step=step, device=device
            ),
            "windows": draw_windows(
                self.table,
                options.counted,
                options.lengths,
                seed=self.seed,
                step=step,
                busy=options.busy,
                device=device,
            ),
        }
        if self.pixels is not None:
            batch["frames"] = draw_pixels(
                self.pixels, self.recipe.pixels, seed=self.seed, step=step, device=device
            )
        return batch

    def losses(self, batch: Batch, step: int) -> Terms:
        """Errors of spans, of windows and of frames; how rough the scene is, and how foggy."""
        assert isinstance(spans := batch["spans"], EventPairs)
        assert isinstance(windows := batch["windows"], EventPairs)
        both = EventPairs.cat([spans, windows])
        true = self.on_time(both)
        change = self.sensor.observe(
            self.scene.sharp(self.sensor.expose(true), step, "events"), true
        )
        negative, positive = self.thresholds(both)
        measured, usual = both.measured(negative, positive), (negative + positive).detach() / 2
        exact, counted = slice(None, len(spans)), slice(len(spans), None)
        change = change[:, 0]
        terms = {
            "spans": exact_error(change[exact], measured[exact], usual[exact]),
            "windows": counted_error(
                change[counted], measured[counted], usual[counted], pull=self.recipe.windows.pull
            ),
            "rough": self.scene.roughness(step),
            "fog": self.scene.fog(step),
        }
        if isinstance(self.thresholds, LearnedThresholds):
            terms["thresholds"] = 1e-2 * self.thresholds.prior()
        if self.pixels is not None:
            assert isinstance(seen := batch["frames"], Pixels)
            light = self.scene.sharp(self.shutter.expose(seen), step, "frames")
            terms["frames"] = self.recipe.frames * mse(
                self.shutter.observe(light, seen), seen.value
            )
        return terms

    def on_time(self, seen: EventPairs) -> EventPairs:
        """Pairs at the times when things happened, instead of those on their cameras' clocks."""
        if self.late is None:
            return seen
        late = (self.late - self.late.mean())[seen.track]
        return replace(seen, start=seen.start - late, end=seen.end - late)

    def render(self, rays: Rays) -> Radiance:
        """Sharp linear light."""
        return self.scene.view(rays)

    def encode(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """As the frames store it."""
        return self.tone.encode(light).clamp(0, 1)

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """As the event camera sees it."""
        return (luma(light) + self.floor).log()

    def groups(self) -> list[Group]:
        """Voxels, thresholds and clocks."""
        groups = self.scene.groups(self.rate)
        if self.late is not None:
            rate = self.recipe.windows.late_rate_us / self.capture.clock.span_us
            groups.append(
                Group("late", (self.late,), exponential(rate, rate / 20, until=self.recipe.decay))
            )
        if isinstance(self.thresholds, LearnedThresholds):
            own = tuple(self.thresholds.parameters())
            groups.append(
                Group("thresholds", own, exponential(1e-3, 1e-4, until=self.recipe.decay))
            )
        return groups
