"""HTML pages in a single file: jinja2 templates, with images, style and script inside.

All text is escaped by the templates (`templates/*.html.j2`); `templates/parts.html.j2` holds what
pages share: figures, sliders that compare images, tables, headline numbers.

Tables of text, for pages and for documents.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8

from sharpfield.core.files import replacing

if TYPE_CHECKING:
    from jinja2 import Environment

Pixels = UInt8[np.ndarray, "h w c"]


@dataclass(frozen=True)
class ImageEncoding:
    """Size and quality of the images inside a page."""

    longest_px: int
    """Larger images are scaled down to this length of their longer side."""
    quality: int
    """Of WebP, 1...100."""


@dataclass(frozen=True)
class CaptionedImage:
    """An image with its caption."""

    kind: str
    """What it is among the images of its view, such as `result`."""
    pixels: Pixels
    caption: str
    alt: str


@dataclass(frozen=True)
class ComparedView:
    """Images from the same pose at the same time, to be compared."""

    name: str
    images: tuple[CaptionedImage, ...]


def render_page(template: str, values: Mapping[str, Any]) -> str:
    """A whole HTML file, which refers to nothing outside itself.

    Args:
        template: File name in `templates/`.
        values: The variables of the template; `title` and `encoding` are needed by all.
    """
    return _environment().get_template(template).render(values)


def write_page(path: Path, template: str, values: Mapping[str, Any]) -> None:
    """Render a page to a file; see `render_page`."""
    text = render_page(template, values)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def data_url(pixels: Pixels, encoding: ImageEncoding) -> str:
    """An image as a `data:` URL, scaled down if it is too large."""
    height, width = pixels.shape[:2]
    factor = min(1.0, encoding.longest_px / max(height, width))
    if factor < 1:
        size = (max(round(width * factor), 1), max(round(height * factor), 1))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        pixels = pixels if pixels.ndim == 3 else pixels[..., None]  # OpenCV drops a single channel
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    _, data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, encoding.quality])
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode()


def video_url(mp4: bytes) -> str:
    """An mp4 video as a `data:` URL."""
    return "data:video/mp4;base64," + base64.b64encode(mp4).decode()


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("sharpfield.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"data_url": data_url, "video_url": video_url}
    return made


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
