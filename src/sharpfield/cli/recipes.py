"""What recipes there are, what they do, and whom to cite."""

import dataclasses
import textwrap
from typing import Any, Literal

from tyro.conf import Positional

from sharpfield.core.errors import OptionError
from sharpfield.recipes import RECIPES, recipe_named
from sharpfield.recipes.choose import presets_of

WIDTH = 96


def recipes(
    what: Positional[Literal["list", "describe", "cite"]] = "list", name: Positional[str] = ""
) -> None:
    """List recipes, describe one with its numbers, or print how to cite it.

    Args:
        what: What to say.
        name: Of the recipe, for describe and cite.
    """
    if what == "list":
        for known, recipe in RECIPES.working().items():
            print(f"{known:<18} {_first_line(recipe)}")
        return
    if not name:
        raise OptionError(f"which recipe? {what} needs a name", do=f"use {', '.join(RECIPES)}")
    recipe = recipe_named(name)
    print(_described(name, recipe) if what == "describe" else _cited(recipe))


def _described(name: str, recipe: Any) -> str:
    lines = [f"{name}: {recipe.paper.title}", "", _first_line(recipe), ""]
    if known := presets_of(recipe).all:
        lines.append("presets")
        lines += [f"  {preset:<16} {_first_line(change)}" for preset, change in known.items()]
        lines.append("")
    lines += ["numbers (train --change NAME=VALUE)", *_numbers(recipe())]
    return "\n".join(lines)


def _numbers(recipe: Any, before: str = "") -> list[str]:
    lines = []
    for field in dataclasses.fields(recipe):
        value = getattr(recipe, field.name)
        if dataclasses.is_dataclass(value):
            lines += _numbers(value, f"{before}{field.name}.")
        else:
            lines.append(f"  {before + field.name:<28} {value}")
    return lines


def _cited(recipe: Any) -> str:
    paper = recipe.paper
    lines = [paper.bibtex, ""]
    if paper.departures:
        lines.append("Where this differs from the published code:")
        lines += [
            textwrap.fill(departure, WIDTH, initial_indent="- ", subsequent_indent="  ")
            for departure in paper.departures
        ]
    return "\n".join(lines)


def _first_line(recipe: Any) -> str:
    return (recipe.__doc__ or "").strip().splitlines()[0]
