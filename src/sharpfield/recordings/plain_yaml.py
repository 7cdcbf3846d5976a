"""YAML as calibration programs write it: mappings, lists, numbers and texts, and nothing else.

Kalibr, ROS, DSEC and OpenCV write a small part of YAML. This reads that part and refuses the rest
(anchors, texts of several lines, several documents), so nothing that a file says can run code or
grow beyond the file.
"""

import re
from pathlib import Path
from typing import Any

from sharpfield.core.errors import CaptureError

MOST_BYTES = 1 << 20
"""A calibration is a page or two."""
MOST_NESTED = 32

COMMENT = re.compile(r"(^|\s)#.*$")
KEY = re.compile(r"""^("[^"]*"|'[^']*'|[^\s\[\]{},"'][^:"']*?)\s*:(\s+(?P<rest>.*))?$""")
TAG = re.compile(r"^![^\s]*\s*")
TOKEN = re.compile(
    r"""\s*("[^"]*"|'[^']*'|[\[\]{},]|:(?=\s)|[^\[\]{},:]+(?::[^\s\[\]{},][^\[\]{},:]*)*)"""
)

Lines = list[tuple[int, int, str]]
"""Number, indentation and text of each line that says something."""


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a file holds.

    Raises:
        CaptureError: It is missing, not a mapping, or uses more of YAML than this reads.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise CaptureError("too large for a calibration", where=path)
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CaptureError("file not found", where=path) from None
    except UnicodeDecodeError as error:
        raise CaptureError("not a text", where=path, got=error) from None
    parser = _Parser(path, _lines(text))
    found = parser.block(0, 0) if parser.lines else {}
    if not isinstance(found, dict) or parser.lines:
        raise parser.refused(parser.lines[0] if parser.lines else (0, 0, "a list"))
    return found


def _lines(text: str) -> Lines:
    """Lines without comments; a list in brackets that goes over several lines becomes one."""
    lines: Lines = []
    open_brackets = 0
    for number, line in enumerate(text.splitlines(), start=1):
        bare = COMMENT.sub("", line.replace("\t", "    ")).rstrip()
        if not bare or bare.startswith(("%", "---", "...")):
            continue
        if open_brackets:
            first, indent, before = lines[-1]
            lines[-1] = first, indent, f"{before} {bare.strip()}"
        else:
            lines.append((number, len(bare) - len(bare.lstrip()), bare.strip()))
        open_brackets += sum(bare.count(c) for c in "[{") - sum(bare.count(c) for c in "]}")
    return lines


class _Parser:
    """Reads lines from the front of `lines`, and takes away what it has read."""

    def __init__(self, path: Path, lines: Lines) -> None:
        self.path, self.lines = path, lines

    def block(self, indent: int, depth: int) -> Any:
        """A mapping or a list whose entries begin at an indentation."""
        self._expect_shallow(depth)
        return self._list(indent, depth) if self._is_item() else self._mapping(indent, depth)

    def refused(self, line: tuple[int, int, str]) -> CaptureError:
        """What to say of a line that is not understood."""
        return CaptureError(
            "cannot read this YAML",
            where=f"{self.path}, line {line[0]}",
            got=line[2][:60],
            do="write plain mappings, lists and numbers, as Kalibr and OpenCV do",
        )

    def _is_item(self) -> bool:
        return self.lines[0][2] == "-" or self.lines[0][2].startswith("- ")

    def _mapping(self, indent: int, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while self.lines and self.lines[0][1] == indent and not self._is_item():
            line = self.lines.pop(0)
            match = KEY.match(line[2])
            if match is None:
                raise self.refused(line)
            found[match[1].strip("\"'")] = self._value(match["rest"] or "", line, depth)
        if self.lines and self.lines[0][1] > indent:
            raise self.refused(self.lines[0])
        return found

    def _list(self, indent: int, depth: int) -> list[Any]:
        found = []
        while self.lines and self.lines[0][1] == indent and self._is_item():
            number, _, text = self.lines.pop(0)
            rest = text[1:].strip()
            if rest == "-" or rest.startswith("- ") or KEY.match(rest):
                # An entry that is itself a block goes on at the indentation of its first line.
                inner = indent + len(text) - len(rest)
                self.lines.insert(0, (number, inner, rest))
                found.append(self.block(inner, depth + 1))
            else:
                found.append(self._value(rest, (number, indent, rest), depth))
        return found

    def _value(self, rest: str, line: tuple[int, int, str], depth: int) -> Any:
        """What follows a key or a dash: on the same line, or on deeper ones."""
        rest = TAG.sub("", rest)
        if rest[:1] in ("&", "*", "|", ">", "]", "}"):
            raise self.refused(line)
        if rest[:1] in ("[", "{"):
            tokens = TOKEN.findall(rest)
            found = self._flow(tokens, line, depth + 1)
            if tokens:
                raise self.refused(line)
            return found
        if rest:
            return _scalar(rest)
        deeper = self.lines and self.lines[0][1] > line[1]
        beside = self.lines and self.lines[0][1] == line[1] and self._is_item()
        if deeper or (beside and not line[2].startswith("-")):
            return self.block(self.lines[0][1], depth + 1)
        return None

    def _flow(self, tokens: list[str], line: tuple[int, int, str], depth: int) -> Any:
        """A value in brackets, or a scalar among such."""
        self._expect_shallow(depth)
        token = tokens.pop(0).strip() if tokens else ""
        if token == "[":
            items: list[Any] = []
            while self._next(tokens, line) != "]":
                items.append(self._flow(tokens, line, depth + 1))
                self._skip_comma(tokens, "]", line)
            tokens.pop(0)
            return items
        if token == "{":
            found: dict[str, Any] = {}
            while self._next(tokens, line) != "}":
                key = tokens.pop(0).strip().strip("\"'")
                if self._next(tokens, line) != ":":
                    raise self.refused(line)
                tokens.pop(0)
                found[key] = self._flow(tokens, line, depth + 1)
                self._skip_comma(tokens, "}", line)
            tokens.pop(0)
            return found
        if token in ("", "]", "}", ",", ":"):
            raise self.refused(line)
        return _scalar(token)

    def _next(self, tokens: list[str], line: tuple[int, int, str]) -> str:
        if not tokens:
            raise self.refused(line)
        return tokens[0].strip()

    def _skip_comma(self, tokens: list[str], end: str, line: tuple[int, int, str]) -> None:
        if self._next(tokens, line) == ",":
            tokens.pop(0)
        elif self._next(tokens, line) != end:
            raise self.refused(line)

    def _expect_shallow(self, depth: int) -> None:
        if depth > MOST_NESTED:
            raise CaptureError("nested too deeply for a calibration", where=self.path)


def _scalar(text: str) -> Any:
    if text[:1] in ("'", '"') and text[-1:] == text[:1] and len(text) > 1:
        return text[1:-1]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False, "null": None, "~": None}.get(text.lower(), text)
