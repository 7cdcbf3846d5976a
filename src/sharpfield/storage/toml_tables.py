"""Tables of a TOML file, read value by value, with errors that name file, table and key."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError

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
    """A table and its position in the file. A value without a fallback is required."""

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
        """True or false."""
        return self._value(key, bool, fallback)

    def numbers(self, key: str, fallback: list[float] | None = None) -> tuple[float, ...]:
        """A list of numbers."""
        return tuple(float(value) for value in self._value(key, list, fallback))

    def table(self, key: str, *, optional: bool = False) -> "Table":
        """A table in this one; an optional one may be missing and is then empty."""
        value = self._value(key, dict, {} if optional else None)
        return Table(value, f"{self.where}, [{key}]")

    def tables(self, key: str) -> list["Table"]:
        """A list of tables in this one; empty if the key is missing."""
        return [
            Table(value, f"{self.where}, {key} number {i}")
            for i, value in enumerate(self._value(key, list, []))
        ]

    def expect_only(self, *known: str) -> None:
        """Refuse keys other than these: a misspelled one would have no effect.

        Raises:
            CaptureError: There is one.
        """
        unknown = sorted(set(self.values) - set(known))
        if unknown:
            raise CaptureError(
                f"unknown key `{unknown[0]}`", where=self.where, do=f"known are {', '.join(known)}"
            )

    def _value(self, key: str, kind: type, fallback: Any) -> Any:
        value = self.values.get(key, fallback)
        if value is None:
            raise CaptureError(f"`{key}` is missing", where=self.where, do="add it")
        accepted = (int, float) if kind is float else kind
        if not isinstance(value, accepted) or isinstance(value, bool) != (kind is bool):
            raise CaptureError(
                f"`{key}` must be {KINDS[kind]}",
                where=self.where,
                got=repr(value),
                do="correct the value",
            )
        return value


def read_toml(path: Path) -> Table:
    """The top table of a file.

    Raises:
        CaptureError: The file is missing or not TOML.
    """
    try:
        return Table(tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except FileNotFoundError:
        raise CaptureError("file not found", where=path, do="check the path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaptureError("not valid TOML", where=path, got=error, do="correct the file") from None
