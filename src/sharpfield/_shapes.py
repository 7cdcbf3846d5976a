"""Arguments of single functions checked against their annotations, with errors that say which."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

from jaxtyping import AbstractArray, jaxtyped

from sharpfield.core.errors import OptionError, ShapeError


def with_shapes_checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which raises a `ShapeError` where an array has not the annotated shape.

    Args:
        function: Annotated with jaxtyping's types. Axes of one name must agree in all arguments.
    """
    signature = inspect.signature(function)
    name = getattr(function, "__name__", repr(function))

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise OptionError(
                f"{name} was called with other arguments than it has",
                got=error,
                do=f"call {name}({', '.join(signature.parameters)})",
            ) from None
        with jaxtyped("context"):
            for argument, value in given.items():
                kind = signature.parameters[argument].annotation
                if _holds_arrays(kind) and not isinstance(value, kind):
                    raise ShapeError(
                        f"`{argument}` of {name} has another shape or type",
                        got=_described(value),
                        do=f"give {_named(kind)}; axes of one name agree in all arguments",
                    )
        return function(*args, **kwargs)

    return checked


def _holds_arrays(kind: Any) -> bool:
    """Whether an annotation is an array, or an array or something else, by class."""
    kinds = getattr(kind, "__args__", (kind,)) if not isinstance(kind, type) else (kind,)
    classes = [one for one in kinds if isinstance(one, type)]
    return len(classes) == len(kinds) and any(issubclass(one, AbstractArray) for one in classes)


def _named(kind: Any) -> str:
    kinds = (kind,) if isinstance(kind, type) else kind.__args__
    return " or ".join("None" if one is type(None) else one.__name__ for one in kinds)


def _described(value: Any) -> str:
    shape = getattr(value, "shape", None)
    if shape is None:
        return type(value).__name__
    return f"{type(value).__name__} {value.dtype} of shape {tuple(shape)}"
