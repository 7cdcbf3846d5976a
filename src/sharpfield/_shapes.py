"""Arguments of single functions checked against their annotations, with errors that say which."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

from jaxtyping import jaxtyped

from sharpfield.core.errors import OptionError, holds_arrays, wrong_array


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
                if holds_arrays(kind) and not isinstance(value, kind):
                    raise wrong_array(f"`{argument}` of {name}", value, kind)
        return function(*args, **kwargs)

    return checked
