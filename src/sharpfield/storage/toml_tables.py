"""Tables of a TOML file: read value by value, with messages that name file, table and key; written.

The standard library reads TOML but does not write it. What is written here reads back exactly,
floats to the last bit, and lists of tables have one line each.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

KINDS = {
    int: "a whole number",
    float: "a number",
    str: "a text",
    bool: "true or false",
    list: "a list",
    dict: "a table",
}


@dataclass(frozen=True)
class Table:
    """A table and where it stands. A value without a fallback must be there."""

    values: Mapping[str, Any]
    where: str

    def whole(self, key: str, fallback: int | None = None) -> int:
        """A whole number."""
        return self._value(key, int, fallback)

    def number(self, key: str, fallback: float | None = None) -> float:
        """A number, whole or not."""
        value = self._value(key, float, fallback)
        return float(value)

    def text(self, key: str, fallback: str | None = None) -> str:
        """A text."""
        return self._value(key, str, fallback)

    def yes(self, key: str, fallback: bool | None = None) -> bool:
        """Whether something is so."""
        return self._value(key, bool, fallback)

    def numbers(self, key: str, fallback: list[float] | None = None) -> tuple[float, ...]:
        """A list of numbers."""
        return tuple(float(value) for value in self._value(key, list, fallback))

    def table(self, key: str, *, optional: bool = False) -> "Table":
        """A table within; an optional one may be missing and is empty then."""
        value = self._value(key, dict, {} if optional else None)
        return Table(value, f"{self.where}, [{key}]")

    def tables(self, key: str) -> list["Table"]:
        """A list of tables within; an empty one if the key is missing."""
        return [
            Table(value, f"{self.where}, {key} number {i}")
            for i, value in enumerate(self._value(key, list, []))
        ]

    def expect_only(self, *known: str) -> None:
        """Refuse keys other than these: a misspelt one would have no effect.

        Raises:
            CaptureError: There is one.
        """
        unknown = sorted(set(self.values) - set(known))
        if unknown:
            raise CaptureError(
                f"unknown key `{unknown[0]}`",
                where=self.where,
                do=f"known are {', '.join(known)}",
            )

    def _value(self, key: str, kind: type, fallback: Any) -> Any:
        value = self.values.get(key, fallback)
        if value is None:
            raise CaptureError(f"`{key}` is missing", where=self.where, do="add it")
        accepted = (int, float) if kind is float else kind
        if not isinstance(value, accepted) or isinstance(value, bool) != (kind is bool):
            raise CaptureError(f"`{key}` must be {KINDS[kind]}", where=self.where, got=repr(value))
        return value


def read_toml(path: Path) -> Table:
    """The top table of a file.

    Raises:
        CaptureError: The file is missing or not TOML.
    """
    try:
        return Table(tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaptureError("not valid TOML", where=path, got=error) from None


def toml_text(values: Mapping[str, Any]) -> str:
    """TOML of values and of tables that hold values; neither is None.

    Args:
        values: Texts, numbers, truths, lists and tables, as `read_toml` returns them.
    """
    plain = [f"{_key(key)} = {_literal(v)}" for key, v in values.items() if not _is_table(v)]
    blocks = ["\n".join(plain)] if plain else []
    for key, value in values.items():
        if _is_table(value):
            lines = [f"{_key(inner)} = {_literal(v)}" for inner, v in value.items()]
            blocks.append("\n".join([f"[{_key(key)}]", *lines]))
    return "\n\n".join(blocks) + "\n"


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping)


def _key(key: str) -> str:
    return key if BARE_KEY.fullmatch(key) else _quoted(key)


def _literal(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_literal(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        if any(_is_table(item) for item in value):
            return "[\n" + "".join(f"    {_literal(item)},\n" for item in value) + "]"
        return "[" + ", ".join(_literal(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(float(value))  # numpy's floats print their type as well
    if isinstance(value, int):
        return str(value)
    assert isinstance(value, str), f"{type(value).__name__} has no TOML"
    return _quoted(value)


def _quoted(text: str) -> str:
    """A basic string. TOML's escapes are JSON's, but for the control character DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
