"""Options of a recipe as flags of the commands that train one.

The flags are made from the recipe's dataclass once its name is known: `--sampling.views 5`. Named
presets change the defaults that the help shows; a flag wins over every preset.
"""

import dataclasses
import functools
import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, get_type_hints

import tyro

from sharpfield.core.errors import Hint, OptionError, did_you_mean, expect_one_of
from sharpfield.recipes import RECIPES, names_in_source, recipe_named
from sharpfield.recipes.settings.options import changed, field_texts, new_name, options_of
from sharpfield.recipes.settings.presets import presets_of


def expect_recipe(words: Sequence[str]) -> None:
    """Refuse a first word that is neither an option nor the name of a recipe.

    Raises:
        OptionError: It is one.
    """
    if words and not words[0].startswith("-"):
        expect_one_of("recipe", words[0], RECIPES)


def expect_known(command: Callable[..., None], words: Sequence[str]) -> None:
    """Refuse options and presets that the named recipe cannot have, before it is imported.

    Raises:
        OptionError: There is one.
    """
    name = recipe_in(words)
    known = None if name is None else names_in_source(name)
    if known is None:
        return
    flags = [word.partition("=")[0] for word in words if word.startswith("--") and word != "--"]
    taken = _flags_of(_own_parameters(command)) | {"help"}
    for flag in flags:
        asked = flag[2:].replace("-", "_").removeprefix("recipe.").removeprefix("no_")
        parts = asked.split(".")
        groups = {".".join(parts[: i + 1]) for i in range(len(parts))}
        if asked not in known.options | taken and not groups & known.old:
            similar = {f"--{one.replace('_', '-')}" for one in known.options | taken}
            raise OptionError("unknown option", got=flag, do=did_you_mean(flag, sorted(similar)))
    for preset in _value_of("--preset", words).replace("+", ",").split(","):
        if preset and preset not in known.presets:
            do = did_you_mean(preset, sorted(known.presets))
            raise OptionError(f"the recipe {name} has no preset {preset!r}", do=do)


def recipe_in(words: Sequence[str]) -> str | None:
    """The name of a recipe among the words of a command, where it is not the value of an option."""
    pairs = zip(["", *words], words, strict=False)
    return next((b for a, b in pairs if b in RECIPES and not a.startswith("--")), None)


def without_recipe_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Takes what a command takes, but for the options of a recipe, and does nothing with it."""

    def ignore(*_: Any, **__: Any) -> None:
        pass

    return _with_parameters(command, _own_parameters(command), lambda options: options, ignore)


def with_recipe_flags(
    command: Callable[..., None], words: Sequence[str]
) -> tuple[Callable[..., None], list[str]]:
    """A command with a flag for each option of the recipe that is named, and its words.

    Args:
        command: Its parameter `numbers` gets the options that were given.
        words: On the command line; old names of options are replaced, with a hint.
    """
    others = _own_parameters(command)
    name = recipe_in(words)
    if name is None:
        return _with_parameters(command, others, lambda options: options), list(words)
    recipe = recipe_named(name)()
    words = renamed(getattr(recipe, "renamed", {}), words)
    presets = presets_of(recipe)
    recipe = presets.apply(presets.named(_value_of("--preset", words), name), recipe)
    taken = _flags_of(others)
    kind = _flags(recipe, taken, name)
    flags = {word[2:].partition("=")[0].replace("-", "_") for word in words if word[:2] == "--"}
    given = [one for one in options_of(recipe) if _flag(one, taken) in flags]
    parameter = inspect.Parameter(
        "numbers",
        inspect.Parameter.KEYWORD_ONLY,
        default=kind(*(getattr(recipe, one.name) for one in dataclasses.fields(kind))),
        annotation=Annotated[kind, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff],
    )

    def with_numbers(options: dict[str, Any]) -> dict[str, Any]:
        made = options["numbers"]
        numbers = {one: functools.reduce(getattr, one.split("."), made) for one in given}
        return {**options, "numbers": numbers}

    return _with_parameters(command, [*others, parameter], with_numbers), words


def hint_at_flags(recipe: str, changes: Sequence[str]) -> None:
    """Say how what `--change` does is written now.

    Raises:
        OptionError: A change is not NAME=VALUE, or the recipe has no such option.
    """
    if changes:
        changed(recipe_named(recipe)(), changes)
        pairs = (change.split("=", 1) for change in changes)
        said = " ".join(f"--{flag_of(a)} {b.replace(',', ' ')}" for a, b in pairs)
        warnings.warn(f"--change will go; write {said}", Hint, stacklevel=2)


def _flags(recipe: Any, taken: set[str], name: str) -> type:
    """A dataclass with the fields of a recipe that become flags.

    Args:
        recipe: Its values are the defaults.
        taken: Flags of the command; a field of such a name gets the flag `--recipe.NAME`.
        name: Of the recipe.
    """
    kinds, meanings = get_type_hints(type(recipe)), field_texts(type(recipe))
    fields: list[tuple[str, Any, Any]] = []
    for one in dataclasses.fields(recipe):
        flag = tyro.conf.arg(name=_flag(one.name, taken), help=meanings.get(one.name))
        value = dataclasses.field(default=getattr(recipe, one.name))
        fields.append((one.name, Annotated[kinds[one.name], flag], value))
    return dataclasses.make_dataclass(
        "Numbers", fields, frozen=True, namespace={"__doc__": f"Options of {name}."}
    )


def _flag(option: str, taken: set[str]) -> str:
    """The flag of an option, which is longer where the command has one of the same name."""
    return f"recipe.{option}" if option in taken else option


def flag_of(option: str) -> str:
    """The flag of an option in `sharpfield train`, without the dashes in front."""
    from sharpfield.cli.learn import train_command

    return _flag(option, _flags_of(_own_parameters(train_command))).replace("_", "-")


def _flags_of(parameters: list[inspect.Parameter]) -> set[str]:
    """Names of the flags of a command, those of its groups of options, too."""
    groups = [one.annotation for one in parameters if dataclasses.is_dataclass(one.annotation)]
    fields = {field.name for group in groups for field in dataclasses.fields(group)}
    return fields | {one.name for one in parameters}


def _own_parameters(command: Callable[..., None]) -> list[inspect.Parameter]:
    return [one for one in inspect.signature(command).parameters.values() if one.name != "numbers"]


def _with_parameters(
    command: Callable[..., None],
    parameters: list[inspect.Parameter],
    change: Callable[[dict[str, Any]], dict[str, Any]],
    run: Callable[..., None] | None = None,
) -> Callable[..., None]:
    """A command with other parameters.

    Args:
        command: Has the documentation.
        parameters: Those to have.
        change: From the options that are given to those that the command takes.
        run: Called instead of the command, if given.
    """

    @functools.wraps(command)
    def call(*positional: Any, **options: Any) -> None:
        (run or command)(*positional, **change(options))

    del call.__wrapped__
    signature = inspect.signature(command)
    parameters = [
        one.replace(annotation=tyro.conf.OmitArgPrefixes[one.annotation])
        if one.name != "numbers"
        else one
        for one in parameters
    ]
    call.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore
    call.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": None}
    return call


def _value_of(flag: str, words: Sequence[str]) -> str:
    for word, after in zip(words, [*words[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name == flag:
            return value if equals else after
    return ""


def renamed(names: Mapping[str, str], words: Sequence[str]) -> list[str]:
    """Words of a command with today's names of options; says which old ones were used."""
    found: list[str] = []
    for word in words:
        flag, equals, value = word.partition("=")
        old = flag[2:].replace("-", "_")
        new = new_name(names, old) if flag.startswith("--") else old
        if new != old:
            new = new.replace("_", "-")
            warnings.warn(f"the option {flag} is now --{new}", Hint, stacklevel=2)
        found.append(word if new == old else f"--{new}{equals}{value}")
    return found
