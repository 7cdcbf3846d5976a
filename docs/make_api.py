"""Writes `docs/api.md` from the docstrings: `python docs/make_api.py`; a test says when to."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sharpfield as sf
from sharpfield import api
from sharpfield.recipes.settings.options import field_texts

OUT = Path(__file__).with_name("api.md")

FUNCTIONS = ("read", "open_recording", "simulate", "write", "deblur", "train", "open_run")
TYPES = ("Run", "Capture", "Frames", "Exposure", "EventStream", "Camera")
ROOMS = ("ops", "events", "losses", "metrics", "simulation", "geometry")
LISTED = ("Args", "Raises")

WIDTH = 100


def main() -> None:
    """Write the page."""
    OUT.write_text(page())


def page() -> str:
    """The whole page."""
    parts = [
        "# Python interface",
        "*Made from the docstrings by `python docs/make_api.py`.*",
        "`import sharpfield as sf` takes a moment; what a name needs is imported when it is first"
        " used. Times are in us on the capture's clock, poses are world-from-camera (x right, y"
        " down, z forward), images of a run are in 0...1. What is wrong raises an"
        " `sf.SharpfieldError` that says what, where, what was found and what to do.",
        "From a capture to an image: [`examples/00_ten_lines.py`](../examples/00_ten_lines.py) and"
        " [a notebook](../examples/from_capture_to_image.ipynb).",
        "## Functions",
        *(part for name in FUNCTIONS for part in function(getattr(api, name), f"sf.{name}")),
        "## Types",
        *(part for name in TYPES for part in record(getattr(sf, name), f"sf.{name}")),
        "Recipes are in `sf.recipes.RECIPES`, by name; `sf.core` has the other types.",
        "## Single parts",
        "Each works alone on tensors or arrays, and says which shape is wrong.",
    ]
    for room in ROOMS:
        offered = getattr(sf, room)
        parts.append(f"### `sf.{room}`: {first_line(offered)}")
        for name in dir(offered):
            parts += list(single(getattr(offered, name), f"sf.{room}.{name}"))
    return "\n\n".join(parts) + "\n"


def single(part: Any, name: str) -> Iterator[str]:
    """A function whole, anything else in a line."""
    if inspect.isfunction(part):
        yield from function(part, name, level=4)
    elif inspect.ismodule(part) or isinstance(part, type):
        yield f"`{name}`: {first_line(part)}"
    else:
        yield f"`{name}`: {', '.join(map(str, part))}"


def function(part: Any, name: str, *, level: int = 3) -> Iterator[str]:
    """Signature and docstring."""
    yield f"{'#' * level} `{name}`"
    yield f"```py\n{signature(part, name)}\n```"
    yield from docstring(part)


def record(part: type, name: str) -> Iterator[str]:
    """A class: its docstring, fields, properties and methods."""
    yield f"### `{name}`"
    yield from docstring(part)
    texts = field_texts(part)
    own = [field for field in getattr(part, "__dataclass_fields__", {}) if field[0] != "_"]
    lines = [f"- `{field}`" + (f": {texts[field]}" if field in texts else "") for field in own]
    methods = []
    for method, value in vars(part).items():
        if method.startswith("_"):
            continue
        plain = getattr(value, "__func__", value)
        if isinstance(value, property) or hasattr(value, "attrname"):  # also a cached property
            text = first_line(value.fget if isinstance(value, property) else value.func)
            lines.append(f"- `{method}`: {text}")
        elif inspect.isfunction(plain):
            methods.append((plain, f"{name.rpartition('.')[2].lower()}.{method}"))
    if lines:
        yield "\n".join(lines)
    for method, called in methods:
        yield from function(method, called, level=4)


def signature(part: Any, name: str) -> str:
    """As it is written in the source, without `self`."""
    source = textwrap.dedent(inspect.getsource(inspect.unwrap(part)))
    tree = ast.parse(source).body[0]
    assert isinstance(tree, ast.FunctionDef)
    plain = tree.args.args
    if plain and plain[0].arg in ("self", "cls"):
        del plain[0]
    returned = f" -> {ast.unparse(tree.returns)}" if tree.returns else ""
    parts = re.split(r", (?=\*|\w+: )", ast.unparse(tree.args))
    parts = [re.sub(r"^(\w+: [^=]*)=", r"\1 = ", one) for one in parts]
    line = f"{name}({', '.join(parts)}){returned}".replace("'", '"')
    if len(line) <= WIDTH:
        return line
    lines = [f"{name}(", *(f"    {one}," for one in parts), f"){returned}"]
    return "\n".join(lines).replace("'", '"')


def docstring(part: Any) -> Iterator[str]:
    """A docstring as paragraphs and lists."""
    for block in re.split(r"\n\n(?=\S)", inspect.getdoc(part) or ""):
        title, _, rest = block.partition(":\n")
        if title in (*LISTED, "Returns") and rest:
            yield f"**{title}**" if title != "Args" else "**Arguments**"
            yield listed(textwrap.dedent(rest)) if title in LISTED else joined(rest)
        else:
            yield block if block.startswith("    ") else joined(block)


def listed(text: str) -> str:
    """The entries `name: text` of a section."""
    entries = re.split(r"\n(?=\S)", text)
    pairs = (joined(entry).partition(": ") for entry in entries)
    return "\n".join(f"- `{name}`: {said}" for name, _, said in pairs)


def joined(text: str) -> str:
    """Lines of a paragraph as one."""
    return " ".join(text.split())


def first_line(part: Any) -> str:
    """Of the docstring."""
    return joined((inspect.getdoc(part) or "").split("\n\n")[0])


if __name__ == "__main__":
    main()
