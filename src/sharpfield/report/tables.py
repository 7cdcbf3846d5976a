"""Tables of metrics, for the terminal, for documents, and for the report."""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

FORMATS = {"psnr": "{:.2f}", "ssim": "{:.4f}", "ssim_paper": "{:.4f}", "lpips": "{:.4f}"}
TITLES = {"psnr": "PSNR (dB)", "ssim": "SSIM", "ssim_paper": "SSIM (paper)", "lpips": "LPIPS"}
LOWER_IS_BETTER = frozenset({"lpips"})
OURS = "this run"


@dataclass(frozen=True)
class Table:
    """Text in rows and columns; the first column names the row."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    """Cells (row, column) to stand out."""


def methods_table(metrics: Mapping[str, Any]) -> Table:
    """Means over held-out views of this run and its baselines; the best of each column marked."""
    means = {OURS: metrics["mean"]}
    means |= {name: other["mean"] for name, other in metrics.get("baselines", {}).items()}
    shown = _present(list(means.values()))
    rows = tuple((name, *(number(key, mean) for key in shown)) for name, mean in means.items())
    return Table(("method", *(TITLES[key] for key in shown)), rows, _best(means, shown))


def views_table(
    views: Sequence[Mapping[str, Any]],
    mean: Mapping[str, Any],
    *,
    input_mean: Mapping[str, Any] | None = None,
) -> Table:
    """One row per view, and their mean.

    Args:
        views: Rows of `metrics.json`.
        mean: Their mean.
        input_mean: Mean over their blurry inputs, to show the inputs' PSNR as well.
    """
    with_input = input_mean is not None
    shown = _present(views)
    columns = ["view", *(TITLES[key] for key in shown)] + ["input PSNR (dB)"] * with_input
    rows = []
    for view in [*views, {"name": "mean", **mean, "input": input_mean or {}}]:
        row = [str(view["name"]), *(number(key, view) for key in shown)]
        rows.append((*row, *[number("psnr", view.get("input", {}))] * with_input))
    return Table(tuple(columns), tuple(rows))


def number(key: str, scores: Mapping[str, Any]) -> str:
    """One score with as many digits as make sense; a dash if there is none."""
    value = scores.get(key)
    return "–" if value is None else FORMATS[key].format(value)


def markdown(table: Table) -> str:
    """The table in Markdown, aligned to be read as plain text too."""
    cells = [list(table.columns)]
    for i, row in enumerate(table.rows):
        cells.append([f"**{t}**" if (i, j) in table.best else t for j, t in enumerate(row)])
    widths = [max(len(row[j]) for row in cells) for j in range(len(table.columns))]
    lines = [
        "| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |"
        for row in cells
    ]
    rule = (
        "|"
        + "|".join(
            ":" + "-" * (w + 1) if j == 0 else "-" * (w + 1) + ":" for j, w in enumerate(widths)
        )
        + "|"
    )
    return "\n".join([lines[0], rule, *lines[1:]])


def as_html(table: Table) -> str:
    """The table in HTML, in a box that scrolls when it is too wide."""
    head = "".join(f'<th scope="col">{html.escape(text)}</th>' for text in table.columns)
    body = ""
    for i, (name, *values) in enumerate(table.rows):
        cells = "".join(
            f"<td{_best_class(table, i, j)}>{html.escape(text)}</td>"
            for j, text in enumerate(values, 1)
        )
        body += f'<tr><th scope="row">{html.escape(name)}</th>{cells}</tr>\n'
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>\n{body}</tbody></table></div>"
    )


def _best_class(table: Table, row: int, column: int) -> str:
    return ' class="best"' if (row, column) in table.best else ""


def _present(scores: Sequence[Mapping[str, Any]]) -> list[str]:
    """The metrics that any row has."""
    return [key for key in FORMATS if any(row.get(key) is not None for row in scores)]


def _best(
    means: Mapping[str, Mapping[str, Any]], shown: Sequence[str]
) -> frozenset[tuple[int, int]]:
    if len(means) < 2:
        return frozenset()
    found = set()
    for column, key in enumerate(shown, 1):
        values = [
            (mean[key], i) for i, mean in enumerate(means.values()) if mean.get(key) is not None
        ]
        found.add(((min if key in LOWER_IS_BETTER else max)(values)[1], column))
    return frozenset(found)
