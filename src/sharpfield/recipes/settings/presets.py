"""Presets: named changes of a recipe, of two kinds that combine.

A *variant* says what is modelled (`blender_full`, `physical`, ...), a *size* how much of it a
machine can take (`draft`, `standard`, `paper`). `--preset physical,draft` applies both. A recipe
states its presets in the class variable `presets`, also a recipe of another package; and the
publication behind it in `paper`, which for ours is in `recipes/papers.toml`.
"""

import tomllib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeVar

from sharpfield.core.errors import Hint, OptionError, did_you_mean
from sharpfield.recipes import recipe_named

if TYPE_CHECKING:  # a list of recipes needs no torch
    from sharpfield.core.capture import Capture
    from sharpfield.core.protocols import Paper, Recipe

R = TypeVar("R")
Change = Callable[[Any], Any]
"""From a recipe to a changed one; the first line of its docstring says what it means."""


@dataclass(frozen=True)
class Presets:
    """The presets of one recipe."""

    variants: Mapping[str, Change] = field(default_factory=dict)
    """What is modelled. They are applied before the size."""
    sizes: Mapping[str, Change] = field(default_factory=dict)
    """How much of it. Where none is named, a CPU gets `draft` and a GPU `standard`."""
    variant_for: Callable[["Capture", str], str] | None = None
    """The variant for a capture and a size, where none is named; None for none."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Old names, accepted with a hint."""

    @property
    def all(self) -> dict[str, Change]:
        """Variants, then sizes."""
        return {**self.variants, **self.sizes}

    def named(self, text: str, recipe: str) -> list[str]:
        """The names in `physical,draft`, the old ones replaced.

        Raises:
            OptionError: There is no preset of such a name.
        """
        names = [name for name in text.replace("+", ",").split(",") if name]
        for old in set(names) & self.renamed.keys():
            warnings.warn(f"the preset {old} is now {self.renamed[old]}", Hint, stacklevel=2)
        names = [self.renamed.get(name, name) for name in names]
        for name in names:
            if name not in self.all:
                raise OptionError(
                    f"the recipe {recipe} has no preset {name!r}", do=did_you_mean(name, self.all)
                )
        return names

    def apply(self, names: list[str], recipe: Any) -> Any:
        """A recipe changed by presets: variants first."""
        for name in sorted(names, key=lambda name: name in self.sizes):
            recipe = self.all[name](recipe)
        return recipe


def published(recipe: R) -> R:
    """The published networks and length."""
    return recipe


NO_PRESETS = Presets()


def presets_of(recipe: Any) -> Presets:
    """The presets of a recipe, or of its class; those of other packages may state none."""
    return getattr(recipe, "presets", NO_PRESETS)


def prepared(name: str, preset: str = "", *, capture: "Capture", device: str) -> "Recipe":
    """A recipe with presets applied; what `preset` leaves open follows capture and machine.

    Args:
        name: Of the recipe.
        preset: Names with commas between them; may be empty.
        capture: What it will be built on.
        device: `cpu` or `cuda`.

    Raises:
        OptionError: There is no such recipe or preset.
    """
    kind = recipe_named(name)
    presets = presets_of(kind)
    chosen = presets.named(preset, name)
    if presets.sizes and not any(one in presets.sizes for one in chosen):
        size = "draft" if device == "cpu" else "standard"
        chosen.append(size if size in presets.sizes else next(iter(presets.sizes)))
    if presets.variant_for and not any(one in presets.variants for one in chosen):
        size = next((one for one in chosen if one in presets.sizes), "")
        chosen.append(presets.variant_for(capture, size))
    return presets.apply(chosen, kind())


def paper_of(recipe: str) -> "Paper":
    """The publication of one of our recipes, with the departures of the recipe from it.

    Args:
        recipe: By the name that the command line knows.
    """
    from sharpfield.core.protocols import Paper  # with torch, which presets do not need

    own = _tables()[recipe]
    cited = _tables()[own.get("reference", recipe)]
    earlier = paper_of(own["departures_of"]).departures if "departures_of" in own else ()
    departures = (*earlier, *own.get("departures", ()))
    return Paper(cited["key"], cited["title"], cited["bibtex"], departures)


@cache
def _tables() -> dict[str, dict[str, Any]]:
    return tomllib.loads(resources.files("sharpfield.recipes").joinpath("papers.toml").read_text())
