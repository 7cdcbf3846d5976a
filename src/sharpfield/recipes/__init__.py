"""Recipes: one paper, one file.

A package of your own adds recipes by the entry point `sharpfield.recipes`.
"""

from importlib.metadata import entry_points
from typing import Any

from sharpfield.core.errors import OptionError
from sharpfield.recipes.d_nerf import DNeRF
from sharpfield.recipes.dynamic_splat import DynamicSplat, EvDynamicSplat
from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF
from sharpfield.recipes.evdnerf import EvDNeRF
from sharpfield.recipes.evdnerf_physical import EvDNeRFPhysical
from sharpfield.recipes.hybrid import Hybrid
from sharpfield.recipes.nerf import NeRF
from sharpfield.recipes.point_nerf import PointNeRF
from sharpfield.recipes.splat import BlurSplat, EdiSplat, EventSplat, EvSplat, RoomSplat, Splat

RECIPES: dict[str, Any] = {
    "nerf": NeRF,
    "ev-deblur-nerf": EvDeblurNeRF,
    "d-nerf": DNeRF,
    "evdnerf": EvDNeRF,
    "evdnerf-physical": EvDNeRFPhysical,
    "dynamic-splat": DynamicSplat,
    "ev-dynamic-splat": EvDynamicSplat,
    "point-nerf": PointNeRF,
    "hybrid": Hybrid,
    "splat": Splat,
    "edi-splat": EdiSplat,
    "blur-splat": BlurSplat,
    "event-splat": EventSplat,
    "ev-splat": EvSplat,
    "room-splat": RoomSplat,
}
"""By the name that the command line knows."""


def all_recipes() -> dict[str, Any]:
    """Ours and those of installed packages."""
    others = {entry.name: entry.load() for entry in entry_points(group="sharpfield.recipes")}
    return {**others, **RECIPES}


def recipe_named(name: str) -> Any:
    """A recipe's class.

    Raises:
        OptionError: There is none of this name.
    """
    known = all_recipes()
    if name not in known:
        raise OptionError("unknown recipe", got=name, do=f"use one of {', '.join(known)}")
    return known[name]


__all__ = [
    "RECIPES",
    "BlurSplat",
    "DNeRF",
    "EvDNeRF",
    "EvDNeRFPhysical",
    "DynamicSplat",
    "EdiSplat",
    "EvDeblurNeRF",
    "EvDynamicSplat",
    "EvSplat",
    "EventSplat",
    "Hybrid",
    "NeRF",
    "PointNeRF",
    "RoomSplat",
    "Splat",
    "all_recipes",
    "recipe_named",
]
