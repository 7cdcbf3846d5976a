"""One error tree. A message says what is wrong, where, what was found, and what to do about it.

Everything that comes from outside (files, the command line, a user's arrays) fails with one of
these; the command line prints the message alone and exits with code 2. Truths internal to the
program are plain assertions.

Also here: the import of optional packages, and the check of users' arrays against annotations.
"""

import dataclasses
import importlib
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from types import ModuleType
from typing import Any, cast


class SharpfieldError(Exception):
    """Something outside the program is wrong, and the user can mend it.

    Args:
        what: One sentence: what is wrong.
        where: The file, dataset, frame or option that is meant.
        got: The value that was found there.
        do: What the user can do about it.
    """

    def __init__(self, what: str, *, where: object = "", got: object = "", do: str = "") -> None:
        self.what, self.where, self.got, self.do = what, str(where), str(got), do
        lines = [f"{type(self).__name__}: {what}"]
        details = {"where": self.where, "got": self.got, "do": self.do}
        lines += [f"  {key:5}  {text}" for key, text in details.items() if text]
        super().__init__("\n".join(lines))


class CaptureError(SharpfieldError):
    """A capture on disk cannot be read, or contradicts itself."""


class ShapeError(SharpfieldError):
    """An array has the wrong shape or type."""


class RunError(SharpfieldError):
    """A run folder or one of its checkpoints cannot be used."""


class OptionError(SharpfieldError):
    """An option, or a combination of options, makes no sense."""


class Hint(UserWarning):
    """Something still works, or was left out; the command line prints it as one line."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """What to do about an unknown name: the known one most like it, or all if none is."""
    names = list(known)
    if close := get_close_matches(name, names, n=1, cutoff=0.6):
        return f"did you mean {close[0]}?"
    return f"use one of {', '.join(names)}" if names else "leave it out: there is none"


def expect_one_of(kind: str, name: str, known: Collection[str]) -> None:
    """Make sure that a name is known.

    Raises:
        OptionError: It is not; `kind` says of what it is the name.
    """
    if name not in known:
        raise OptionError(f"unknown {kind}", got=name, do=did_you_mean(name, known))


class MissingExtra(SharpfieldError):
    """An optional package is needed and not installed."""

    def __init__(self, package: str, *, extra: str, purpose: str) -> None:
        super().__init__(
            f"{purpose} needs the package {package!r}", do=f"pip install 'sharpfield[{extra}]'"
        )


def need(package: str, *, extra: str, purpose: str) -> ModuleType:
    """Import an optional package.

    Args:
        package: Import name, e.g. `hdf5plugin`.
        extra: The extra of `sharpfield` that installs it.
        purpose: What the user was about to do, to begin the error message.

    Raises:
        MissingExtra: The package is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as missing:
        if missing.name != package.partition(".")[0]:
            raise
        raise MissingExtra(package, extra=extra, purpose=purpose) from None


def expect_arrays(record: Any) -> None:
    """Make sure that the arrays in a dataclass have the shapes and types of their annotations.

    Args:
        record: An instance; axes of one name must agree in all its fields.

    Raises:
        ShapeError: They have others; the first is named.
    """
    from jaxtyping import jaxtyped  # pyright: ignore[reportUnknownVariableType]

    with jaxtyped("context"):
        for field in dataclasses.fields(record):
            value: Any = getattr(record, field.name)
            if holds_arrays(field.type) and not isinstance(value, cast(type, field.type)):
                raise wrong_array(f"`{field.name}` of {type(record).__name__}", value, field.type)


def wrong_array(what: str, value: Any, kind: Any) -> ShapeError:
    """The error about an array that has not the annotated shape or type."""
    kinds = (kind,) if isinstance(kind, type) else kind.__args__
    names = ["None" if one is type(None) else one.__name__ for one in kinds]
    got = type(value).__name__
    if (shape := getattr(value, "shape", None)) is not None:
        got += f" {value.dtype} of shape {tuple(shape)}"
    return ShapeError(
        f"{what} has another shape or type",
        got=got,
        do=f"give {' or '.join(names)}; axes of one name agree",
    )


def holds_arrays(kind: Any) -> bool:
    """Whether an annotation is an array of jaxtyping, or a union of such with other classes."""
    from jaxtyping import AbstractArray

    kinds = (kind,) if isinstance(kind, type) else getattr(kind, "__args__", ())
    classes = [one for one in kinds if isinstance(one, type)]
    return len(classes) == len(kinds) and any(issubclass(one, AbstractArray) for one in classes)
