"""Recipes: one paper, one file. They are imported when they are asked for.

A package of your own adds recipes by the entry point `sharpfield.recipes`.
"""

import ast
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sharpfield.core.errors import OptionError, did_you_mean
from sharpfield.core.plugins import Registry

if TYPE_CHECKING:  # the names of recipes are known without importing torch
    from sharpfield.core.protocols import Recipe

OWN = {
    "nerf": "sharpfield.recipes.nerf:NeRF",
    "ev-deblur-nerf": "sharpfield.recipes.ev_deblur_nerf:EvDeblurNeRF",
    "d-nerf": "sharpfield.recipes.d_nerf:DNeRF",
    "evdnerf": "sharpfield.recipes.evdnerf:EvDNeRF",
    "evdnerf-physical": "sharpfield.recipes.evdnerf_physical:EvDNeRFPhysical",
    "dynamic-splat": "sharpfield.recipes.splat:DynamicSplat",
    "ev-dynamic-splat": "sharpfield.recipes.splat:EvDynamicSplat",
    "point-nerf": "sharpfield.recipes.point_nerf:PointNeRF",
    "hybrid": "sharpfield.recipes.hybrid:Hybrid",
    "splat": "sharpfield.recipes.splat:Splat",
    "edi-splat": "sharpfield.recipes.splat:EdiSplat",
    "blur-splat": "sharpfield.recipes.splat:BlurSplat",
    "event-splat": "sharpfield.recipes.splat:EventSplat",
    "ev-splat": "sharpfield.recipes.splat:EvSplat",
    "room-splat": "sharpfield.recipes.splat:RoomSplat",
}
"""Where the recipes of this package are."""

RECIPES: "Registry[type[Recipe]]" = Registry("sharpfield.recipes", OWN)
"""Classes by the name that the command line knows; those of other packages included."""


def recipe_named(name: str) -> "type[Recipe]":
    """A recipe's class.

    Raises:
        OptionError: There is none of this name.
    """
    recipe = RECIPES.get(name)
    if recipe is None:
        raise OptionError("unknown recipe", got=name, do=did_you_mean(name, RECIPES))
    return recipe


def summaries() -> dict[str, str]:
    """A line about each recipe. Our own are read in the source, so that no recipe is imported."""
    found = {name: _summary_in_source(reference) for name, reference in OWN.items()}
    for name in RECIPES:
        if name not in OWN and (recipe := RECIPES.get(name)) is not None:
            found[name] = summary_of(recipe)
    return found


def summary_of(recipe: Any) -> str:
    """The first line of the docstring of a recipe, or of a preset."""
    return next(iter((recipe.__doc__ or "").strip().splitlines()), "")


def _summary_in_source(reference: str) -> str:
    module, name = reference.split(":")
    path = Path(__file__).with_name(f"{module.rpartition('.')[2]}.py")
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    raise AssertionError(f"{path} has no class {name}")
