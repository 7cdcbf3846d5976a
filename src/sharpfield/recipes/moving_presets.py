"""Presets of the recipes for moving scenes."""

from dataclasses import replace
from typing import TypeVar

from sharpfield.fields.space_time import SpaceTimeSize
from sharpfield.recipes.d_nerf import DNeRF
from sharpfield.recipes.dynamic_splat import DynamicSplat
from sharpfield.recipes.evdnerf import EvDNeRF
from sharpfield.recipes.evdnerf_physical import EvDNeRFPhysical

R = TypeVar("R", EvDNeRF, DNeRF)


def published(recipe: R) -> R:
    """The published networks and length."""
    return recipe


def lego(recipe: EvDNeRF) -> EvDNeRF:
    """The paper's recipe for low contrast: a dead zone, and a tenth of the rate."""
    return replace(recipe, rate=recipe.rate / 10, dead_zone=True)


def real(recipe: EvDNeRF) -> EvDNeRF:
    """The paper's recipe for real data: two networks, no compression."""
    curriculum = replace(recipe.curriculum, windows=(99,), stages=(0,), crop=5_000, times=30_000)
    scene = replace(recipe.scene, networks=2)
    return replace(recipe, steps=50_000, gamma=0.0, curriculum=curriculum, scene=scene)


def evdnerf_draft(recipe: EvDNeRF) -> EvDNeRF:
    """Smaller networks, fewer pixels, a higher rate; minutes on two CPU cores."""
    scene = replace(recipe.scene, width=64, depth=6, samples=(24, 24))
    return replace(recipe.lasting(2000), rate=10 * recipe.rate, pairs=128, scene=scene)


def evdnerf_standard(recipe: EvDNeRF) -> EvDNeRF:
    """Half as wide and a tenth as long; for a GPU."""
    scene = replace(recipe.scene, width=128, samples=(48, 64))
    return replace(recipe.lasting(20_000), rate=5 * recipe.rate, scene=scene)


def d_nerf_draft(recipe: DNeRF) -> DNeRF:
    """Smaller networks, fewer pixels, a higher rate; minutes on two CPU cores."""
    scene = replace(recipe.scene, width=64, depth=6, samples=(24, 24))
    return replace(recipe.lasting(2000), rate=2e-3, pixels=256, scene=scene)


def d_nerf_standard(recipe: DNeRF) -> DNeRF:
    """Half as wide; for a GPU."""
    scene = replace(recipe.scene, width=128, samples=(48, 64))
    return replace(recipe.lasting(40_000), rate=1e-3, pixels=1024, scene=scene)


def physical_draft(recipe: EvDNeRFPhysical) -> EvDNeRFPhysical:
    """Minutes on two CPU cores."""
    windows = replace(recipe.windows, spans=64, counted=320)
    return replace(recipe.lasting(2000), windows=windows)


def physical_standard(recipe: EvDNeRFPhysical) -> EvDNeRFPhysical:
    """Finer in space and time; an hour on a CPU."""
    size = SpaceTimeSize(still=96, moving=80, moments=48)
    scene = replace(recipe.scene, size=size, steps=96)
    windows = replace(recipe.windows, spans=256, counted=1280)
    return replace(recipe.lasting(12_000), scene=scene, windows=windows)


def dynamic_draft(recipe: DynamicSplat) -> DynamicSplat:
    """Minutes on two CPU cores."""
    return recipe.lasting(8000)


def dynamic_standard(recipe: DynamicSplat) -> DynamicSplat:
    """More Gaussians, and more cameras and instants in each step; an hour on a CPU."""
    return replace(
        recipe.lasting(20_000),
        gaussians=replace(recipe.gaussians, density=1.5, density_moving=4.5),
        looks=replace(recipe.looks, cameras=4, instants=5),
    )


EVDNERF_VARIANTS = {"lego": lego, "real": real}
EVDNERF_SIZES = {"draft": evdnerf_draft, "standard": evdnerf_standard, "paper": published}
D_NERF_SIZES = {"draft": d_nerf_draft, "standard": d_nerf_standard, "paper": published}
PHYSICAL_SIZES = {"draft": physical_draft, "standard": physical_standard}
DYNAMIC_SIZES = {"draft": dynamic_draft, "standard": dynamic_standard}
