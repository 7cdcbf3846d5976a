"""What all benchmarks share: the machine they ran on, tables on the screen, results on disk."""

import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from sharpfield.core.files import replacing

RESULTS = Path(__file__).parent / "results"

Row = dict[str, Any]
"""One line of a table: column by column."""


def machine() -> dict[str, Any]:
    """What a number depends on besides the code, and which code it was."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": CPU(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "commit": commit(),
    }


def CPU() -> str:
    """The CPU's name, as far as the system tells."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.CPU() or platform.machine()


def commit() -> str:
    """The checked-out commit, with a plus if files differ from it."""
    here = Path(__file__).parent

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=here, capture_output=True, text=True)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no")
    return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")


def show(rows: list[Row]) -> None:
    """Print rows of the same columns; the first column to the left, numbers to the right."""
    names = list(rows[0])
    cells = [names, *[[written(row[name]) for name in names] for row in rows]]
    widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
    for line in cells:
        first, *rest = (
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        print("  ".join([first, *rest]), flush=True)


def written(value: Any) -> str:
    """A cell: three digits of a number, a dash for what was not measured."""
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def save(name: str, rows: list[Row], facts: Row) -> Path:
    """Write rows, what else is worth knowing, and the machine to `results/<name>.json`."""
    path = RESULTS / f"{name}.json"
    text = json.dumps({"machine": machine(), **facts, "rows": rows}, indent=2)
    with replacing(path) as temporary:
        temporary.write_text(text + "\n")
    return path
