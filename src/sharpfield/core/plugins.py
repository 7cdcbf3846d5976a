"""Plug-in points: what other packages add by entry points, loaded when it is first asked for.

A package names its objects in its own `pyproject.toml`, one line each:

    [project.entry-points."sharpfield.recipes"]
    my-paper = "my_package.my_paper:MyPaper"

The groups are `sharpfield.recipes`, `sharpfield.layouts`, `sharpfield.formats`,
`sharpfield.metrics` and `sharpfield.lenses`. An entry point that cannot be loaded is named in one
warning and left out; everything else goes on working.
"""

import warnings
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar, cast

from sharpfield.core.errors import Hint, OptionError, did_you_mean


class PluginWarning(Hint):
    """An installed package offers something that cannot be used."""


T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Objects by name: our own, and those of installed packages, which are loaded when asked for.

    Args:
        group: Name of the entry points, such as `sharpfield.recipes`.
        own: Our own objects, or `module:name` references to import when one is asked for. They win
            over entry points of the same name.
    """

    def __init__(self, group: str, own: Mapping[str, T | str]) -> None:
        self.group, self.own = group, dict(own)

    def __getitem__(self, name: str) -> T:
        if name in self.own:
            found = self.own[name]
            if isinstance(found, str):
                found = self.own[name] = cast(T, EntryPoint(name, found, self.group).load())
            return found
        found = _loaded(_installed(self.group)[name])
        if found is None:
            raise KeyError(name)
        return found

    def __contains__(self, name: object) -> bool:
        """Whether there is an object of this name; it is not loaded."""
        return name in self.own or name in _installed(self.group)

    def __iter__(self) -> Iterator[str]:
        """Names of our own objects, then of those of other packages, none of which is loaded."""
        yield from self.own
        yield from (name for name in _installed(self.group) if name not in self.own)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def named(self, name: str, what: str) -> T:
        """The object of this name; `what` says in one word what the objects are.

        Raises:
            OptionError: There is none of this name.
        """
        found = self.get(name)
        if found is None:
            raise OptionError(f"unknown {what}", got=name, do=did_you_mean(name, self))
        return found

    def working(self) -> dict[str, T]:
        """All objects that can be loaded."""
        found = {name: self.get(name) for name in self}
        return {name: one for name, one in found.items() if one is not None}


def _installed(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}


@cache
def _loaded(entry: EntryPoint) -> Any | None:
    """The object of an entry point, or None with a warning. Whatever a stranger raises is told."""
    try:
        return entry.load()
    except Exception as error:  # noqa: BLE001 - a package of others may fail in any way
        warnings.warn(
            f"the entry point {entry.name} = {entry.value} of {entry.group} cannot be loaded and"
            f" is left out ({type(error).__name__}: {error})",
            PluginWarning,
            stacklevel=2,
        )
        return None
