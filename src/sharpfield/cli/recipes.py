"""`sharpfield recipes`: what recipes there are, what they do, and whom to cite."""

import textwrap
from typing import Any, Literal

from tyro.conf import Positional

from sharpfield.cli.recipe_options import flag_of
from sharpfield.core.errors import OptionError
from sharpfield.recipes import RECIPES, recipe_named, summaries, summary_of
from sharpfield.recipes.settings.options import Option, options_of
from sharpfield.recipes.settings.presets import presets_of

WIDTH = 96
COLUMN = 34


def recipes_command(
    what: Positional[Literal["list", "describe", "cite"]] = "list", name: Positional[str] = ""
) -> None:
    """List recipes, describe one with its presets and options, or print how to cite it.

    Args:
        what: What to print.
        name: Name of the recipe, for describe and cite.
    """
    if what == "list":
        for known, summary in summaries().items():
            print(f"{known:<18} {summary}")
        return
    if not name:
        raise OptionError(f"which recipe? {what} needs a name", do=f"use {', '.join(RECIPES)}")
    recipe = recipe_named(name)
    print(_described(name, recipe) if what == "describe" else _cited(recipe))


def _described(name: str, recipe: Any) -> str:
    """Presets with what they change, then options with their defaults and meanings."""
    default = options_of(recipe())
    lines = [f"{name}: {recipe.paper.title}", "", summary_of(recipe), ""]
    if presets := presets_of(recipe).all:
        lines.append("presets (--preset NAME, or several with commas between them)")
    for preset, change in presets.items():
        lines.append(f"  {preset:<16} {summary_of(change)}")
        for option, after in options_of(change(recipe())).items():
            if option not in default or after.value != default[option].value:
                before = _text(default[option]) if option in default else "none"
                lines.append(f"      --{flag_of(option):<{COLUMN - 4}} {before} -> {_text(after)}")
    lines += ["", f"options of `sharpfield train {name}`, with their defaults"]
    for option in default.values():
        lines.append(f"  --{flag_of(option.name):<{COLUMN}} {_text(option)}")
        lines += textwrap.wrap(
            option.meaning, WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6
        )
    return "\n".join(lines)


def _text(option: Option) -> str:
    """A value as it is written on the command line."""
    if isinstance(option.value, tuple):
        return " ".join(str(one) for one in option.value)
    return '""' if option.value == "" else str(option.value)


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
