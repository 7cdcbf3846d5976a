"""Tables of text, for pages and for documents."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TextTable:
    """Text in rows and columns; the first column names the row."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    """Cells (row, column) to emphasise."""


def markdown(table: TextTable) -> str:
    """The table in Markdown, aligned to be read as plain text too."""
    cells = [list(table.columns)]
    for i, row in enumerate(table.rows):
        cells.append([f"**{t}**" if (i, j) in table.best else t for j, t in enumerate(row)])
    widths = [max(len(row[j]) for row in cells) for j in range(len(table.columns))]
    lines = [
        "| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |"
        for row in cells
    ]
    rules = [":" + "-" * (widths[0] + 1), *("-" * (width + 1) + ":" for width in widths[1:])]
    return "\n".join([lines[0], f"|{'|'.join(rules)}|", *lines[1:]])
