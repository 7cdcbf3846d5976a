"""Building blocks of a single-file page: images inside it, figures, sliders, tables."""

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources

import cv2
import numpy as np
from jaxtyping import UInt8

LONG = 8
"""Tables with more rows are folded."""

Colours = UInt8[np.ndarray, "h w c"]


@dataclass(frozen=True)
class Look:
    """How much room images may take."""

    longest_px: int
    quality: int
    """Of WebP, 1...100."""


@dataclass(frozen=True)
class Image:
    """A image with what it shows."""

    kind: str
    """What it is among the images of its view, e.g. `result`."""
    pixels: Colours
    caption: str
    alt: str


@dataclass(frozen=True)
class View:
    """Images of the same place at the same time, to be compared."""

    name: str
    images: tuple[Image, ...]


def embedded(pixels: Colours, look: Look) -> str:
    """A image as the address of itself."""
    height, width = pixels.shape[:2]
    shrink = min(1.0, look.longest_px / max(height, width))
    if shrink < 1:
        size = (max(round(width * shrink), 1), max(round(height * shrink), 1))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    swapped = np.ascontiguousarray(pixels[..., ::-1])
    _, data = cv2.imencode(".webp", swapped, [cv2.IMWRITE_WEBP_QUALITY, look.quality])
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode()


def figure(image: Image, look: Look) -> str:
    """A image with its caption."""
    height, width = image.pixels.shape[:2]
    return (
        f'<figure data-kind="{html.escape(image.kind)}">'
        f'<img src="{embedded(image.pixels, look)}" width="{width}" height="{height}"'
        f' alt="{html.escape(image.alt)}" loading="lazy">'
        f"<figcaption>{html.escape(image.caption)}</figcaption></figure>"
    )


def drawing(svg: str | None, caption: str) -> str:
    """A drawing with its caption; nothing if there is no drawing."""
    if svg is None:
        return ""
    return f'<figure class="drawing">{svg}<figcaption>{html.escape(caption)}</figcaption></figure>'


def video(data: bytes, caption: str) -> str:
    """An mp4 video with its caption, played over and over without sound."""
    told = html.escape(caption)
    address = "data:video/mp4;base64," + base64.b64encode(data).decode()
    return (
        f'<figure><video src="{address}" aria-label="{told}" controls autoplay loop muted'
        f" playsinline></video><figcaption>{told}</figcaption></figure>"
    )


def comparison(views: Sequence[View], look: Look, *, left: str, right: str, first: str = "") -> str:
    """Views in rows of images; with JavaScript, a slider above them compares any two.

    Args:
        views: What to compare.
        look: Of the images.
        left: Kind of the image on the slider's left at first.
        right: And on its right.
        first: Name of the view to begin with; the first in order if there is none of it.
    """
    rows = "\n".join(
        f'<div class="view" data-name="{html.escape(view.name)}">'
        + "".join(figure(image, look) for image in view.images)
        + "</div>"
        for view in views
    )
    return (
        f'<div class="compare" data-left="{html.escape(left)}" data-right="{html.escape(right)}"'
        f' data-first="{html.escape(first)}">\n{rows}\n</div>'
    )


def section(title: str, *parts: str, intro: str = "") -> str:
    """A part of the page under a heading; nothing if it holds nothing."""
    inside = "\n".join(part for part in parts if part)
    if not inside:
        return ""
    text = f'<p class="intro">{html.escape(intro)}</p>\n' if intro else ""
    return f"<section>\n<h2>{html.escape(title)}</h2>\n{text}{inside}\n</section>"


def folded(summary: str, inside: str) -> str:
    """Something long, closed at first."""
    return f"<details><summary>{html.escape(summary)}</summary>{inside}</details>" if inside else ""


def folded_if_long(title: str, inside: str, rows: int) -> str:
    """Something under a small heading; closed at first if it has many rows."""
    if rows > LONG:
        return folded(f"{title} ({rows})", inside)
    return f"<h3>{html.escape(title)}</h3>\n{inside}"


def cards(values: Sequence[tuple[str, str, str]]) -> str:
    """Headline numbers: value, what it is, a remark."""
    items = "".join(
        f'<li><span class="value">{html.escape(value)}</span><span class="label">'
        f'{html.escape(label)}</span><span class="remark">{html.escape(remark)}</span></li>'
        for value, label, remark in values
    )
    return f'<ul class="cards">{items}</ul>'


def definitions(values: Mapping[str, object]) -> str:
    """Names and what stands for them."""
    items = "".join(
        f"<dt>{html.escape(name)}</dt><dd>{html.escape(str(value))}</dd>"
        for name, value in values.items()
    )
    return f"<dl>{items}</dl>" if items else ""


def page(title: str, body: str) -> str:
    """The whole file; it refers to nothing outside itself."""
    style, script = (
        resources.files("sharpfield.report").joinpath(f"page.{kind}").read_text()
        for kind in ("css", "js")
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{html.escape(title)}</title>
<style>
{style}</style>
</head>
<body>
{body}
<script>
{script}</script>
</body>
</html>
"""
