"""Names that a package offers and imports only when they are asked for (PEP 562).

A package lists them once, as ordinary imports that only type checkers and editors carry out:

    if TYPE_CHECKING:
        from sharpfield.ops.compositing import composite as composite

    __getattr__, __dir__ = lazily(__name__, __file__)

The same lines, read as text, tell where each name is found when it is first used.
"""

import ast
import importlib
from collections.abc import Callable
from typing import Any


def lazily(
    package: str, file: str, *, check_shapes: bool = False
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package.

    Args:
        package: Its name.
        file: Its `__init__.py`, whose imports under `if TYPE_CHECKING` are the names on offer.
        check_shapes: Whether functions check the shapes of their arguments when called by these
            names. Inside the project they are imported from where they are defined, unchecked.
    """
    with open(file, encoding="utf-8") as source:
        offered = offers(source.read())

    def __getattr__(name: str) -> Any:
        if name not in offered:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, member = offered[name]
        if f"{module}.{member}" == f"{package}.{name}":
            return importlib.import_module(f"{module}.{member}")  # a module of the package itself
        found = getattr(importlib.import_module(module), member)
        if check_shapes and callable(found) and not isinstance(found, type):
            from sharpfield._shapes import with_shapes_checked  # not before it is needed

            found = with_shapes_checked(found)
        setattr(importlib.import_module(package), name, found)
        return found

    return __getattr__, lambda: sorted(offered)


def offers(source: str) -> dict[str, tuple[str, str]]:
    """Each name that a module imports for type checkers: the module it is in, its name there."""
    found = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for line in node.body:
                assert isinstance(line, ast.ImportFrom) and line.module, ast.unparse(line)
                for alias in line.names:
                    found[alias.asname or alias.name] = (line.module, alias.name)
    return found
