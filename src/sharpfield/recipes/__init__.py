"""Recipes: one paper, one file. They are imported when they are asked for.

A package of your own adds recipes by the entry point `sharpfield.recipes`.
"""

import ast
from collections.abc import Iterator
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


def names_in_source(name: str) -> tuple[set[str], set[str]] | None:
    """Options of a recipe of our own, and old names of options with all other keys of its tables.

    The source is read, not imported: what is in neither set is no option of the recipe.
    """
    if name not in OWN:
        return None
    module, class_name = OWN[name].split(":")
    mentioned: set[str] = set()
    return set(_fields_in_source(module, class_name, mentioned)), mentioned


def _fields_in_source(module: str, name: str, mentioned: set[str]) -> Iterator[str]:
    """Names of the fields of a dataclass; keys of tables in its module are added to `mentioned`."""
    tree = _source(module)
    mentioned |= {
        key.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Dict)
        for key in node.keys
        if isinstance(key, ast.Constant) and isinstance(key.value, str)
    }
    found_in = {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for imported, _ in found_in.values():  # tables of old names may be elsewhere
        if imported.endswith(".renamed"):
            list(_fields_in_source(imported, "", mentioned))
    definitions = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    for node in (one for one in definitions if one.name == name):
        for base in node.bases:
            if isinstance(base, ast.Name):
                yield from _fields_in_source(
                    *found_in.get(base.id, (module, base.id)), mentioned=mentioned
                )
        for field in node.body:
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                yield field.target.id
                kind = field.annotation
                if isinstance(kind, ast.Name) and (
                    kind.id in found_in or kind.id in {one.name for one in definitions}
                ):
                    where, inner = found_in.get(kind.id, (module, kind.id))
                    if where.startswith("sharpfield."):
                        inside = _fields_in_source(where, inner, mentioned)
                        yield from (f"{field.target.id}.{option}" for option in inside)


def _source(module: str) -> ast.Module:
    parts = module.split(".")[1:]
    return ast.parse(Path(__file__).parents[1].joinpath(*parts).with_suffix(".py").read_text())


def _summary_in_source(reference: str) -> str:
    module, name = reference.split(":")
    for node in _source(module).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    raise AssertionError(f"{module} has no class {name}")
