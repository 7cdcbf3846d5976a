"""Recipes: one paper, one file. They are imported when they are asked for.

A package of your own adds recipes by the entry point `sharpfield.recipes`.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    return RECIPES.named(name, "recipe")


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


@dataclass
class SourceNames:
    """What the source of a recipe says of itself, read without importing it."""

    options: set[str] = field(default_factory=set)
    """Names of options; those of dataclasses in the recipe follow a dot."""
    presets: set[str] = field(default_factory=set)
    old: set[str] = field(default_factory=set)
    """Old names of options and groups, with all other keys of tables."""


def names_in_source(name: str) -> SourceNames | None:
    """The options and presets of a recipe of our own; None for those of other packages."""
    if name not in OWN:
        return None
    found = SourceNames()
    module, _, kind = OWN[name].partition(":")
    found.options |= set(_fields_in_source(module, kind, found))
    return found


def _fields_in_source(module: str, name: str, found: SourceNames) -> Iterator[str]:
    """Names of the fields of a dataclass; the keys of tables in its module go to `found`."""
    tree = _source(module)
    found.old |= _keys(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            found.presets |= _keys(node) if node.func.id == "Presets" else set()
    homes = {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    homes |= {one: (module, one) for one in classes}
    if name not in classes:
        return
    for base in classes[name].bases:
        if isinstance(base, ast.Name) and homes.get(base.id, ("", ""))[0].startswith("sharpfield."):
            yield from _fields_in_source(*homes[base.id], found)
    for node in classes[name].body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id
            kind = node.annotation.id if isinstance(node.annotation, ast.Name) else ""
            if homes.get(kind, ("", ""))[0].startswith("sharpfield."):
                inside = _fields_in_source(*homes[kind], found)
                yield from (f"{node.target.id}.{option}" for option in inside)


def _keys(tree: ast.AST) -> set[str]:
    """Texts that are keys of dictionaries."""
    tables = (node for node in ast.walk(tree) if isinstance(node, ast.Dict))
    keys = (key.value for table in tables for key in table.keys if isinstance(key, ast.Constant))
    return {key for key in keys if isinstance(key, str)}


def _source(module: str) -> ast.Module:
    parts = module.split(".")[1:]
    return ast.parse(Path(__file__).parents[1].joinpath(*parts).with_suffix(".py").read_text())


def _summary_in_source(reference: str) -> str:
    module, name = reference.split(":")
    for node in _source(module).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    raise AssertionError(f"{module} has no class {name}")
