"""`sharpfield inspect`: what a capture, or a file of events, holds."""

import json as json_format
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from sharpfield.captures.layout import ReadOptions


def inspect_command(
    path: Positional[Path],
    json: bool = False,
    layout: str | None = None,
    event_unit: str | None = None,
    trust_pickle: bool = False,
) -> None:
    """Print what a capture, or a file of events, holds.

    Args:
        path: Folder of a capture, or a file of events.
        json: Print JSON instead of text.
        layout: Layout of the capture, if it is not recognised.
        event_unit: Unit of event times (ns, us, ms, s), where the file does not say.
        trust_pickle: Open pickled files, which may name programs to run; only arrays of numbers
            are built from them, and anything else is refused.
    """
    from sharpfield.captures.summary import path_summary

    options = ReadOptions(layout=layout, event_unit=event_unit, trust_pickle=trust_pickle)
    found = path_summary(path, options)
    print(json_format.dumps(found, indent=2) if json else as_text(found))


def as_text(found: dict[str, Any], indent: int = 0) -> str:
    """Nested values, a line each."""
    lines = []
    for key, value in found.items():
        if isinstance(value, dict):
            lines += [" " * indent + key, as_text(value, indent + 2)]
        else:
            shown = f"{value:,}" if isinstance(value, int) and value > 9999 else value
            lines.append(f"{' ' * indent}{key:<{22 - indent}} {shown}")
    return "\n".join(lines)
