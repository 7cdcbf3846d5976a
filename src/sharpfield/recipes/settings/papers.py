"""The publications behind the recipes, from `recipes/papers.toml`."""

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from sharpfield.core.protocols import Paper


def paper_of(recipe: str) -> Paper:
    """The publication of one of our recipes, with the departures of the recipe from it.

    Args:
        recipe: By the name that the command line knows.
    """
    own = _tables()[recipe]
    cited = _tables()[own.get("reference", recipe)]
    earlier = paper_of(own["departures_of"]).departures if "departures_of" in own else ()
    departures = (*earlier, *own.get("departures", ()))
    return Paper(cited["key"], cited["title"], cited["bibtex"], departures)


@cache
def _tables() -> dict[str, dict[str, Any]]:
    return tomllib.loads(resources.files("sharpfield.recipes").joinpath("papers.toml").read_text())
