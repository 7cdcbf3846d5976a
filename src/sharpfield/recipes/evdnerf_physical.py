"""EvDNeRF made physical: a dynamic scene from events of several cameras, and frames if any.

The task of A. Bhattacharya et al., *EvDNeRF: Reconstructing Event Data with Dynamic Neural Radiance
Fields*, WACV 2024, with an exact event model. Density is unbounded and the background constant.
Both instants of a window are rendered at the same samples, so that what is static makes no event at
all. Events are counted in windows of any length, at full resolution. The change of log intensity in
a window that begins and ends with events of its pixel is known exactly; in other windows up to a
threshold.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sharpfield.core.capture import Capture
from sharpfield.core.measurements import Batch, EventPairs, Pixels, Terms
from sharpfield.core.protocols import Paper
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
from sharpfield.recipes.settings.presets import Presets, paper_of
from sharpfield.recipes.volume.moving_scenes import MovingOptions, MovingScene
from sharpfield.recipes.volume.scene import FrameModel
from sharpfield.sampling.event_windows import Lengths, draw_spans, draw_windows
from sharpfield.sampling.pixels_and_pairs import draw_pixels, pair_table, pixel_table
from sharpfield.storage.event_cache import event_index


@dataclass(frozen=True)
class WindowOptions:
    """Windows of events in a batch, and their errors."""

    exact: int = 128
    """Windows per step that begin and end with an event of their pixel."""
    counted: int = 640
    """Other windows per step."""
    active_fraction: float = 0.5
    """Fraction of the other windows at pixels with an event in them; the rest are at any pixel."""
    lengths: Lengths = Lengths(shortest=1 / 8)
    """Lengths of the other windows. Long ones tell most, as one end often sees the static
    background; exact windows may be short."""
    residual_weight: float = 0.2
    """Weight of an error that a change below the threshold may explain."""
    threshold: tuple[float, float] | None = None
    """Contrast threshold to darker and to brighter, natural log; None takes that of the capture,
    or 0.2."""
    learn_threshold: bool = False
    """Learn one threshold for each polarity; needs frames, as events leave their scale open."""
    learn_offset: bool = False
    """Learn the clock offset of each camera against the mean of all cameras."""
    offset_lr_us: float = 100.0
    """First learning rate of the clock offsets, in us a step."""
    floor: float = 1e-5
    """Linear light added before the logarithm, where the capture does not state it."""


def draft(recipe: "EvDNeRFPhysical") -> "EvDNeRFPhysical":
    """Minutes on two CPU cores."""
    windows = replace(recipe.windows, exact=64, counted=320)
    return replace(recipe.lasting(2000), windows=windows)


def standard(recipe: "EvDNeRFPhysical") -> "EvDNeRFPhysical":
    """Finer in space and time; an hour on a CPU."""
    size = VoxelSizes(static=96, moving=80, moments=48)
    scene = replace(recipe.scene, size=size, samples=96)
    windows = replace(recipe.windows, exact=256, counted=1280)
    return replace(recipe.lasting(12_000), scene=scene, windows=windows)


@dataclass(frozen=True)
class EvDNeRFPhysical:
    """A dynamic scene from exactly counted events, and from frames if there are any."""

    paper: ClassVar[Paper] = paper_of("evdnerf-physical")
    renamed: ClassVar[dict[str, str]] = {
        "rate": "lr",
        "decay": "lr_decay_steps",
        "frames": "frame_weight",
        "scene.steps": "scene.samples",
        "scene.clear": "scene.static_density",
        "scene.solid": "scene.moving_density",
        "scene.empty": "scene.density_weight",
        "scene.smooth": "scene.tv_weight",
        "scene.steady": "scene.time_tv_weight",
        "windows.spans": "windows.exact",
        "windows.busy": "windows.active_fraction",
        "windows.pull": "windows.residual_weight",
        "windows.learn_late": "windows.learn_offset",
        "windows.late_rate_us": "windows.offset_lr_us",
    }
    presets: ClassVar[Presets] = Presets(sizes={"draft": draft, "standard": standard})

    steps: int = 6000
    """Length of the schedule in steps."""
    lr: float = 0.1
    """First learning rate of the voxels (Adam)."""
    lr_decay_steps: int = 6000
    """Steps in which the learning rate falls to a tenth."""
    scene: MovingOptions = field(default_factory=MovingOptions)
    windows: WindowOptions = field(default_factory=WindowOptions)
    pixels: int = 512
    """Pixels of frames per step, if there are frames."""
    instants: int = 3
    """Instants of a blurred exposure that are averaged."""
    frame_weight: float = 500.0
    """Weight of the squared error of frames."""

    def lasting(self, steps: int) -> "EvDNeRFPhysical":
        """The same recipe with its whole schedule stretched or shrunk to `steps`."""
        return replace(
            self,
            steps=steps,
            lr_decay_steps=max(round(self.lr_decay_steps * steps / self.steps), 1),
        )

    def build(self, capture: Capture, seed: int) -> "Model":
        """The model of this recipe on one capture."""
        return Model(self, capture, seed)


class Model(FrameModel):
    """A dynamic scene, its events and its frames."""

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
        unknown = recipe.windows.learn_offset
        self.offset = nn.Parameter(torch.zeros(index.tracks)) if unknown else None
        """Clock offset of each track, in units of the duration of the capture."""
        use_frames = capture.frames is not None and recipe.pixels > 0
        self.pixels = pixel_table(self.capture) if use_frames else None
        blurred = capture.frames is not None and not capture.frames.exposure.instant.all()
        instants = recipe.instants if blurred else 1
        self.shutter = Shutter(camera, path, instants, self.tone.encode)
        self.lr = exponential(recipe.lr, recipe.lr / 10, until=recipe.lr_decay_steps)

    def draw(self, step: int) -> Batch:
        """Exact windows, other windows, and pixels of frames."""
        options, device = self.recipe.windows, self.scene.device
        batch: Batch = {
            "spans": draw_spans(
                self.table, options.exact, seed=self.seed, step=step, device=device
            ),
            "windows": draw_windows(
                self.table,
                options.counted,
                options.lengths,
                seed=self.seed,
                step=step,
                busy=options.active_fraction,
                device=device,
            ),
        }
        if self.pixels is not None:
            batch["frames"] = draw_pixels(
                self.pixels, self.recipe.pixels, seed=self.seed, step=step, device=device
            )
        return batch

    def losses(self, batch: Batch, step: int) -> Terms:
        """Errors of windows and frames, total variation, density penalty."""
        assert isinstance(spans := batch["spans"], EventPairs)
        assert isinstance(windows := batch["windows"], EventPairs)
        both = EventPairs.cat([spans, windows])
        true = self.without_offset(both)
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
                change[counted],
                measured[counted],
                usual[counted],
                pull=self.recipe.windows.residual_weight,
            ),
            "rough": self.scene.total_variation(step),
            "fog": self.scene.density_penalty(step),
        }
        if isinstance(self.thresholds, LearnedThresholds):
            terms["thresholds"] = 1e-2 * self.thresholds.prior()
        if self.pixels is not None:
            assert isinstance(seen := batch["frames"], Pixels)
            light = self.scene.sharp(self.shutter.expose(seen), step, "frames")
            terms["frames"] = self.recipe.frame_weight * mse(
                self.shutter.observe(light, seen), seen.value
            )
        return terms

    def without_offset(self, seen: EventPairs) -> EventPairs:
        """Pairs with the clock offsets of their cameras removed."""
        if self.offset is None:
            return seen
        offset = (self.offset - self.offset.mean())[seen.track]
        return replace(seen, start=seen.start - offset, end=seen.end - offset)

    def render(self, rays: Rays) -> Radiance:
        """Sharp linear light along rays."""
        return self.scene.view(rays)

    def log_light(self, light: Float[Tensor, "*b c"]) -> Float[Tensor, "*b"]:
        """Log intensity of the event camera."""
        return (luma(light) + self.floor).log()

    def groups(self) -> list[Group]:
        """Parameters of voxels, thresholds and clocks with their learning rates."""
        groups, until = self.scene.groups(self.lr), self.recipe.lr_decay_steps
        if self.offset is not None:
            rate = self.recipe.windows.offset_lr_us / self.capture.clock.span_us
            groups.append(Group("late", (self.offset,), exponential(rate, rate / 20, until=until)))
        if isinstance(self.thresholds, LearnedThresholds):
            own = tuple(self.thresholds.parameters())
            groups.append(Group("thresholds", own, exponential(1e-3, 1e-4, until=until)))
        return groups
