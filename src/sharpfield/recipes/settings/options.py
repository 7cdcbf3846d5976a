"""The numbers of a recipe by name: what there is, what each means, and recipes with others.

The options of a recipe are the fields of its dataclass, and those of the dataclasses in it, whose
names follow a dot: `sampling.views`. What a field means is the text below it.
"""

import ast
import dataclasses
import inspect
import textwrap
import types
import typing
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import tyro

from sharpfield.core.errors import Hint, OptionError, did_you_mean

R = TypeVar("R")


@dataclass(frozen=True)
class Option:
    """One number of a recipe."""

    name: str
    kind: Any
    """Its type."""
    value: Any
    """What the recipe has; its default, if the recipe is as its class makes it."""
    meaning: str
    """With its unit, if it has one."""


def options_of(recipe: Any, group: str = "") -> dict[str, Option]:
    """All options of a recipe by name, groups in the order of their fields."""
    found: dict[str, Option] = {}
    kinds, meanings = typing.get_type_hints(type(recipe)), field_texts(type(recipe))
    for field in dataclasses.fields(recipe):
        name, value = f"{group}{field.name}", getattr(recipe, field.name)
        if dataclasses.is_dataclass(value):
            found |= options_of(value, f"{name}.")
        else:
            meaning = meanings.get(field.name, "")
            found[name] = Option(name, kinds[field.name], value, meaning)
    return found


def with_options(recipe: R, values: Mapping[str, Any]) -> R:
    """A recipe with some of its options changed.

    Args:
        recipe: Stays as it is.
        values: By dotted name, such as `{"gaussians.degree": 3}`; old names are accepted with a
            hint.

    Raises:
        OptionError: The recipe has no such option, or it takes another type of value.
    """
    for given, value in values.items():
        name = current_name(recipe, given)
        option = options_of(recipe)[name]
        if not _fits(value, option.kind):
            raise OptionError(
                f"the option {name!r} takes another type of value",
                got=repr(value),
                do=f"give {getattr(option.kind, '__name__', option.kind)}, such as"
                f" {option.value!r}",
            )
        value = tuple(value) if isinstance(value, list) else value
        recipe = _replaced(recipe, name.split("."), value)
    return recipe


def changed(recipe: R, changes: Sequence[str]) -> R:
    """A recipe with some of its options changed, each written as NAME=VALUE.

    Raises:
        OptionError: A change is not NAME=VALUE, or the recipe has no such option.
    """
    words: list[str] = []
    for change in changes:
        name, equals, value = change.partition("=")
        if not equals:
            raise OptionError("cannot read a change of the recipe", got=change, do="NAME=VALUE")
        words += [f"--{current_name(recipe, name)}", *value.split(",")]
    if not words:
        return recipe
    # Without flags, so that a boolean takes its value like every other option: NAME=False.
    return tyro.cli(
        type(recipe),
        prog="--change",
        default=recipe,
        args=words,
        config=(tyro.conf.FlagConversionOff,),
    )


def current_name(recipe: Any, name: str) -> str:
    """The name of an option today; says so if it had another before.

    Args:
        recipe: Or its class. A class variable `renamed` maps old names, of options or of whole
            groups, to new ones.
        name: With `-` or `_`.

    Raises:
        OptionError: The recipe has no such option.
    """
    asked, known = name.replace("-", "_"), options_of(recipe)
    name = new_name(getattr(recipe, "renamed", {}), asked)
    if name not in known:
        raise OptionError("the recipe has no such option", got=asked, do=did_you_mean(name, known))
    if name != asked:
        warnings.warn(f"the option {asked} is now {name}", Hint, stacklevel=3)
    return name


def new_name(renamed: Mapping[str, str], name: str) -> str:
    """The name that replaced an old one, or the same; `renamed` may name whole groups."""
    for old, new in renamed.items():
        if name == old or name.startswith(f"{old}."):
            return new + name.removeprefix(old)
    return name


def _replaced(record: Any, path: list[str], value: Any) -> Any:
    first, *rest = path
    if rest:
        value = _replaced(getattr(record, first), rest, value)
    return dataclasses.replace(record, **{first: value})


@cache
def field_texts(kind: type) -> dict[str, str]:
    """The text below each field of a dataclass, also of those that it inherits."""
    texts: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if dataclasses.is_dataclass(one):
            texts |= dict(_texts(textwrap.dedent(inspect.getsource(one))))
    return texts


def _texts(source: str) -> Iterator[tuple[str, str]]:
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    for field, below in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                yield field.target.id, " ".join(str(below.value.value).split())


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value may stand where a dataclass field asks for a type."""
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind in (types.UnionType, typing.Union):
        return any(_fits(value, one) for one in inner)
    if kind is typing.Literal:
        return value in inner
    if kind is tuple:
        if not isinstance(value, tuple | list):
            return False
        if inner[-1:] == (...,):
            return all(_fits(one, inner[0]) for one in value)
        return len(value) == len(inner) and all(map(_fits, value, inner))
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return not isinstance(hint, type) or isinstance(value, hint)
