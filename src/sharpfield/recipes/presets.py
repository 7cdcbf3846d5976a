"""Presets: named changes of a recipe, of two kinds that combine.

A *variant* says what is modelled (`blender_full`, `physical`, ...), a *size* how much of it a
machine can take (`draft`, `standard`, `paper`). `--preset physical,draft` applies both, in order.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from sharpfield.core.capture import Capture
from sharpfield.core.errors import OptionError
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF
from sharpfield.recipes.moving_presets import (
    D_NERF_SIZES,
    DYNAMIC_SIZES,
    EVDNERF_SIZES,
    EVDNERF_VARIANTS,
    PHYSICAL_SIZES,
)
from sharpfield.recipes.nerf import NeRF
from sharpfield.recipes.point_presets import HYBRID_SIZES, HYBRID_VARIANTS, POINT_SIZES
from sharpfield.recipes.splat import Splat
from sharpfield.recipes.volume.event_term import EventOptions
from sharpfield.recipes.volume.frame_terms import FrameOptions, PriorOptions
from sharpfield.recipes.volume.learned_blur import KernelOptions
from sharpfield.recipes.volume.scene import VolumeOptions


def blender_full(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """The paper's recipe for its synthetic data."""
    return replace(
        recipe,
        smooth=1.0,
        frames=FrameOptions(),
        kernel=KernelOptions(),
        events=EventOptions(),
        prior=PriorOptions(),
    )


def blender_minus(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """Ev-DeblurNeRF--: no prior and no learned response; events follow display values."""
    return replace(
        blender_full(recipe),
        events=EventOptions(response="gamma"),
        prior=PriorOptions(weight=0.0),
    )


def cdavis_full(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """The paper's recipe for its real data: colour events; frames count once blur is modelled."""
    return replace(
        blender_full(recipe),
        frames=FrameOptions(frames_from=1201),
        events=EventOptions(pairs=2048, threshold=(0.25, 0.25), half_pixel=False),
        prior=PriorOptions(weight=1.0, end=1.0),
    )


def physical(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """Known motion instead of a learned kernel, sharp targets all along each exposure."""
    return replace(
        recipe,
        smooth=0.02,
        volume=replace(recipe.volume, noise=0.0, density="softplus"),
        frames=FrameOptions(blur="auto", blurred_pixels=256, blur_from=20_000),
        kernel=KernelOptions(integration="samples", norm="layer"),
        events=EventOptions(response="residual"),
        prior=PriorOptions(weight=1.0, end=0.1, until=30_000, domain="linear"),
    )


GRID_RATE = 0.2
"""Learning rate of a dense grid, whose cells are density and colour themselves."""

NETWORK_RATE = 5e-3
"""Learning rate of what is learned beside it: the published one."""

DRAFT: dict[str, Any] = {"kind": "voxels", "voxels": (0, 0), "samples": (96, 0), "noise": 0.0}

STANDARD: dict[str, Any] = {
    "voxels": (160**3, 320**3),
    "channels": (32, 16, 16),
    "coarse": (64, 15, 64),
    "fine": (128, 64, 128),
    "octaves": (6, 4),
    "samples": (48, 48),
    "precision": "auto",
}


def draft(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """Minutes on two CPU cores: a dense grid instead of planes and networks."""
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
        rate=GRID_RATE,
        decay=1000,
        smooth=0.0,
        volume=replace(recipe.volume, **DRAFT),
        frames=frames,
        kernel=replace(recipe.kernel, rate=NETWORK_RATE),
        events=replace(
            recipe.events, pairs=512, weight=2 * recipe.events.weight, rate=NETWORK_RATE
        ),
    )


def standard(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """Minutes on a GPU, hours on a CPU."""
    return replace(recipe.lasting(10_000), volume=replace(recipe.volume, **STANDARD))


def paper(recipe: EvDeblurNeRF) -> EvDeblurNeRF:
    """The published size and length."""
    whole = VolumeOptions()
    volume = replace(
        recipe.volume,
        voxels=whole.voxels,
        channels=whole.channels,
        coarse=whole.coarse,
        fine=whole.fine,
        octaves=whole.octaves,
        samples=whole.samples,
        precision="auto",
    )
    return replace(recipe.lasting(30_000), rate=5e-3, volume=volume)


def nerf_draft(recipe: NeRF) -> NeRF:
    """A dense grid instead of large networks; minutes on two CPU cores."""
    return NeRF(steps=2000, rate=GRID_RATE, decay=1000, pixels=1024, volume=VolumeOptions(**DRAFT))


def nerf_standard(recipe: NeRF) -> NeRF:
    """Planes; minutes on a GPU."""
    volume = VolumeOptions(kind="planes", noise=0.0, density="softplus", **STANDARD)
    return NeRF(steps=10_000, rate=5e-3, decay=3333, smooth=0.02, volume=volume)


def nerf_paper(recipe: NeRF) -> NeRF:
    """The published networks and length."""
    return NeRF()


def refine(recipe: Splat) -> Splat:
    """Thresholds, poses and the clocks' offset are learned, too."""
    unknowns = replace(recipe.unknowns, thresholds="signs", knots=REFINED_KNOTS, offset=True)
    looks = recipe.looks
    if looks.sharp > 0:
        # Sharp images are made with the thresholds that are believed, and would confirm them.
        looks = replace(looks, early=0.3, sharp=0.01, windows=0.01, longest_us=200_000)
    return replace(recipe, looks=looks, unknowns=unknowns)


def splat_draft(recipe: Splat) -> Splat:
    """Minutes on two CPU cores."""
    return recipe.lasting(6000)


def splat_standard(recipe: Splat) -> Splat:
    """Minutes on a GPU: more Gaussians, which shine, and more views of each exposure."""
    return replace(
        recipe.lasting(15_000),
        gaussians=replace(recipe.gaussians, degree=3, density=1.5),
        looks=replace(recipe.looks, instants=max(recipe.looks.instants, 5)),
    )


Change = Callable[[Any], Any]
SPLATS = ("splat", "edi-splat", "blur-splat", "event-splat", "ev-splat", "room-splat")

REFINED_KNOTS = 48
"""Knots of a refined trajectory."""

VARIANTS: Mapping[str, Mapping[str, Change]] = {
    "ev-deblur-nerf": {
        "physical": physical,
        "blender_full": blender_full,
        "blender_minus": blender_minus,
        "cdavis_full": cdavis_full,
    },
    "evdnerf": EVDNERF_VARIANTS,
    "hybrid": HYBRID_VARIANTS,
    **dict.fromkeys(SPLATS, {"refine": refine}),
}
"""What is modelled, by recipe; others have no variants."""

SIZES: Mapping[str, Mapping[str, Change]] = {
    "ev-deblur-nerf": {"draft": draft, "standard": standard, "paper": paper},
    "nerf": {"draft": nerf_draft, "standard": nerf_standard, "paper": nerf_paper},
    "d-nerf": D_NERF_SIZES,
    "evdnerf": EVDNERF_SIZES,
    "evdnerf-physical": PHYSICAL_SIZES,
    "dynamic-splat": DYNAMIC_SIZES,
    "ev-dynamic-splat": DYNAMIC_SIZES,
    "point-nerf": POINT_SIZES,
    "hybrid": HYBRID_SIZES,
    **dict.fromkeys(SPLATS, {"draft": splat_draft, "standard": splat_standard}),
}
"""How much of it, by recipe."""


def names(recipe: str) -> dict[str, str]:
    """The presets of a recipe, and what each means."""
    changes = {**VARIANTS.get(recipe, {}), **SIZES.get(recipe, {})}
    return {name: (change.__doc__ or "").strip() for name, change in changes.items()}


def prepared(recipe: str, start: Any, preset: str, *, capture: Capture, device: str) -> Any:
    """A recipe with presets applied; what `preset` leaves open follows capture and machine.

    Without a size, a CPU gets `draft` and a GPU `standard`. Without a variant, the
    size `paper` gets the published recipe for this kind of sensor and the others `physical`.

    Args:
        recipe: Its name.
        start: The recipe with its own defaults.
        preset: Names with commas between them; may be empty.
        capture: What it will be built on.
        device: `cpu` or `cuda`.

    Raises:
        OptionError: A name is unknown.
    """
    variants, sizes = VARIANTS.get(recipe, {}), SIZES.get(recipe, {})
    chosen = [name for name in preset.replace("+", ",").split(",") if name]
    for name in chosen:
        if name not in variants and name not in sizes:
            raise OptionError(
                f"the recipe {recipe} has no preset {name!r}",
                do=f"use {', '.join([*variants, *sizes])}, or several with commas between them",
            )
    if sizes and not any(name in sizes for name in chosen):
        chosen.append("draft" if device == "cpu" else "standard")
    published_too = "physical" in variants
    if published_too and not any(name in variants for name in chosen):
        coloured = capture.events is not None and capture.events.coloured
        published = "cdavis_full" if coloured else "blender_full"
        chosen.insert(0, published if "paper" in chosen else "physical")
    for name in sorted(chosen, key=lambda name: name in sizes):  # variants first
        start = {**variants, **sizes}[name](start)
    return start
