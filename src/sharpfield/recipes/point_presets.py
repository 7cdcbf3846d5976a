"""Presets of the recipes on neural points."""

from dataclasses import replace
from typing import TypeVar

from sharpfield.fields.points.networks import PointSizes
from sharpfield.initialisation.point_cloud import CloudOptions
from sharpfield.recipes.hybrid import Hybrid
from sharpfield.recipes.point_nerf import PointNeRF
from sharpfield.recipes.points.growth import GrowthOptions
from sharpfield.recipes.points.model import DrawOptions
from sharpfield.recipes.points.scene import MarchOptions

P = TypeVar("P", bound=PointNeRF)


def h_only(recipe: Hybrid) -> Hybrid:
    """H of the paper: single pixels, no blur, all frames alike."""
    drawn = replace(recipe.drawn, patches=3136, side=1)
    return replace(recipe, drawn=drawn, blur=replace(recipe.blur, kind="none"), quality="even")


def rooms(recipe: Hybrid) -> Hybrid:
    """Full as the paper has it for simulated rooms: 12 kernels, patches up to 6 pixels apart."""
    blur = replace(recipe.blur, strokes="through")
    return replace(recipe, blur=blur, drawn=replace(recipe.drawn, apart=(1, 6)))


def learned(recipe: Hybrid) -> Hybrid:
    """Full with a kernel learned for each patch."""
    return replace(recipe, blur=replace(recipe.blur, kind="learned"))


def no_images(recipe: Hybrid) -> Hybrid:
    """The control of the paper: points alone."""
    return replace(recipe, sources=replace(recipe.sources, count=0))


def point_draft(recipe: P) -> P:
    """Minutes on two CPU cores: small networks on averaged neighbours, and first colours."""
    recipe = _quick(recipe, points=50_000, width=64, feature=64, pixels=1024, asked=12)
    return replace(recipe.lasting(2000), rate=2e-3, points_rate=5e-3, decay=0.05)


def point_standard(recipe: P) -> P:
    """Minutes on a GPU, hours on a CPU."""
    recipe = _quick(recipe, points=1_000_000, width=128, feature=128, pixels=3136, asked=16)
    return replace(recipe.lasting(20_000), rate=1e-3, points_rate=4e-3, decay=0.05)


def point_paper(recipe: P) -> P:
    """The published networks, points and length."""
    return recipe


def hybrid_draft(recipe: Hybrid) -> Hybrid:
    """Minutes on two CPU cores; sources by pose, what hides them by depth, light adds up."""
    return replace(_knowing(point_draft(recipe)), merge=32)


def hybrid_standard(recipe: Hybrid) -> Hybrid:
    """Minutes on a GPU, hours on a CPU."""
    return _knowing(point_standard(recipe))


def _quick(recipe: P, *, points: int, width: int, feature: int, pixels: int, asked: int) -> P:
    """What needs no weights of another data set to learn fast."""
    whole = recipe.drawn.side**2
    drawn = DrawOptions(
        patches=max(pixels // whole, 1),
        side=recipe.drawn.side,
        apart=(1, 3),
        frames=8,
        border=0,
    )
    return replace(
        recipe,
        start_colours=True,
        drawn=drawn,
        cloud=CloudOptions(
            budget=points, colours="fused", nearest=0.0, farthest=float("inf"), frames="train"
        ),
        sizes=PointSizes(
            channels=16,
            width=width,
            feature=feature,
            octaves=(0, 3, 2),
            axes="world",
            average="early",
            unit=0.0,
        ),
        march=MarchOptions(voxel=0.0, steps=0, asked=asked, thickness=1.0, background=0.5),
        growth=GrowthOptions(every=0.1, until=0.5, most=2 * points),
    )


def _knowing(recipe: Hybrid) -> Hybrid:
    """Images chosen and seen through by what poses and depth tell."""
    sources = replace(
        recipe.sources,
        choose="pose",
        fetch="bilinear",
        visibility="depth",
        trust=1.0,
        prefer=1.0,
    )
    judged = recipe.quality if recipe.quality == "even" else "auto"
    return replace(
        recipe, sources=sources, quality=judged, blur=replace(recipe.blur, light="linear")
    )


POINT_SIZES = {"draft": point_draft, "standard": point_standard, "paper": point_paper}
HYBRID_SIZES = {"draft": hybrid_draft, "standard": hybrid_standard, "paper": point_paper}
HYBRID_VARIANTS = {
    "h-only": h_only,
    "rooms": rooms,
    "learned": learned,
    "no-images": no_images,
}
