"""Recipes: one paper, one file. They are imported when they are asked for.

A package of your own adds recipes by the entry point `sharpfield.recipes`.
"""

from typing import Any

from sharpfield.core.errors import OptionError, did_you_mean
from sharpfield.core.plugins import Registry

RECIPES = Registry(
    "sharpfield.recipes",
    {
        "nerf": "sharpfield.recipes.nerf:NeRF",
        "ev-deblur-nerf": "sharpfield.recipes.ev_deblur_nerf:EvDeblurNeRF",
        "d-nerf": "sharpfield.recipes.d_nerf:DNeRF",
        "evdnerf": "sharpfield.recipes.evdnerf:EvDNeRF",
        "evdnerf-physical": "sharpfield.recipes.evdnerf_physical:EvDNeRFPhysical",
        "dynamic-splat": "sharpfield.recipes.dynamic_splat:DynamicSplat",
        "ev-dynamic-splat": "sharpfield.recipes.dynamic_splat:EvDynamicSplat",
        "point-nerf": "sharpfield.recipes.point_nerf:PointNeRF",
        "hybrid": "sharpfield.recipes.hybrid:Hybrid",
        "splat": "sharpfield.recipes.splat:Splat",
        "edi-splat": "sharpfield.recipes.splat:EdiSplat",
        "blur-splat": "sharpfield.recipes.splat:BlurSplat",
        "event-splat": "sharpfield.recipes.splat:EventSplat",
        "ev-splat": "sharpfield.recipes.splat:EvSplat",
        "room-splat": "sharpfield.recipes.splat:RoomSplat",
    },
)
"""Classes by the name that the command line knows; those of other packages included."""


def recipe_named(name: str) -> Any:
    """A recipe's class.

    Raises:
        OptionError: There is none of this name.
    """
    recipe = RECIPES.get(name)
    if recipe is None:
        raise OptionError("unknown recipe", got=name, do=did_you_mean(name, RECIPES))
    return recipe
