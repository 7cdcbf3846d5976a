"""The page of a checkup: findings first, then what they rest on."""

import html
from pathlib import Path

import numpy as np

from sharpfield.core.capture import Capture
from sharpfield.core.files import replacing
from sharpfield.preparation.doctor.findings import Checkup, Curve, Finding
from sharpfield.report import page
from sharpfield.report.capture import captured
from sharpfield.report.page import Image, Look, section

LOOK = Look(900, 82)
INK = {"error": "#c2281a", "warning": "#b8801f", "note": "#5f6b7a"}
WIDTH, HEIGHT, MARGIN = 300, 170, 40
"""Of a drawing, and the room for its numbers."""
WIDE = 1.9
"""Width over height from which on a image gets a row of its own."""


def write_page(path: Path, checkup: Checkup, capture: Capture | None) -> None:
    """Write the page.

    Args:
        path: Where.
        checkup: What was found.
        capture: What was looked at; None if it could not be read.
    """
    parts = [
        _header(checkup),
        section("Findings", "\n".join(_finding(one) for one in checkup.sorted)),
        section("What was seen", _images(checkup)),
        section("What was tried", _curves(checkup)),
        captured(capture, LOOK) if capture is not None else "",
    ]
    body = "\n".join(part for part in parts if part)
    with replacing(path) as temporary:
        temporary.write_text(page.page(f"{checkup.name}: checkup", body), encoding="utf-8")


def verdict(checkup: Checkup) -> str:
    """The whole in one sentence."""
    counts = checkup.counts
    if counts["error"]:
        said = f"{counts['error']} error{'s' * (counts['error'] > 1)} to mend before training"
    else:
        said = "nothing stands in the way of training"
    warnings = counts["warning"]
    return said + (f", {warnings} warning{'s' * (warnings > 1)}" if warnings else "")


def _header(checkup: Checkup) -> str:
    values = [(str(count), f"{kind}s", "") for kind, count in checkup.counts.items()]
    return (
        f'<header>\n<p class="eyebrow">sharpfield doctor</p>\n<h1>{html.escape(checkup.name)}</h1>'
        f'\n<p class="subtitle">{html.escape(verdict(checkup))}</p>\n{page.cards(values)}</header>'
    )


def _finding(one: Finding) -> str:
    colour = INK[one.severity]
    lines = [
        f'<p style="margin:0"><strong style="color:{colour}">{one.severity}</strong>'
        f" <code>{html.escape(one.check)}</code> {html.escape(one.what)}</p>"
    ]
    lines += [
        f'<p style="margin:.15rem 0 0" class="intro">{label} {html.escape(text)}</p>'
        for label, text in (("got:", one.got), ("do:", one.do))
        if text
    ]
    return f'<div class="note" style="border-color:{colour}">{"".join(lines)}</div>'


def _images(checkup: Checkup) -> str:
    figures = [
        page.figure(
            Image("evidence", np.ascontiguousarray(pixels), caption, caption.capitalize()), LOOK
        )
        for caption, pixels in checkup.images.items()
    ]
    wide = [pixels.shape[1] > WIDE * pixels.shape[0] for pixels in checkup.images.values()]
    small = "".join(one for one, alone in zip(figures, wide, strict=True) if not alone)
    large = "".join(one for one, alone in zip(figures, wide, strict=True) if alone)
    return f'<div class="row">{small}</div>{large}' if figures else ""


def _curves(checkup: Checkup) -> str:
    drawn = [
        f'<figure class="drawing">{_drawn(curve)}'
        f"<figcaption>{html.escape(curve.title)}</figcaption></figure>"
        for curve in checkup.curves
        if len(curve.x) > 1 and np.isfinite(curve.y).all()
    ]
    return f'<div class="row">{"".join(drawn)}</div>' if drawn else ""


def _drawn(curve: Curve) -> str:
    """A line with its extremes named, in the page's own colours."""
    left, right = float(curve.x.min()), float(curve.x.max())
    low, high = float(curve.y.min()), float(curve.y.max())
    across = MARGIN + (curve.x - left) / max(right - left, 1e-12) * (WIDTH - 2 * MARGIN)
    up = HEIGHT - MARGIN - (curve.y - low) / max(high - low, 1e-12) * (HEIGHT - 2 * MARGIN)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, up, strict=True))
    style = 'fill="currentColor" font-size="12"'
    texts = [
        (MARGIN, HEIGHT - MARGIN + 16, "middle", f"{left:.4g}"),
        (WIDTH - MARGIN, HEIGHT - MARGIN + 16, "middle", f"{right:.4g}"),
        (WIDTH / 2, HEIGHT - 8, "middle", curve.across),
        (MARGIN - 6, HEIGHT - MARGIN, "end", f"{low:.2g}"),
        (MARGIN - 6, MARGIN + 4, "end", f"{high:.2g}"),
    ]
    labels = "".join(
        f'<text x="{x}" y="{y}" text-anchor="{anchor}" {style}>{html.escape(text)}</text>'
        for x, y, anchor, text in texts
    )
    axes = f"M{MARGIN},{MARGIN}V{HEIGHT - MARGIN}H{WIDTH - MARGIN}"
    return (
        f'<svg role="img" aria-label="{html.escape(curve.title)}" viewBox="0 0 {WIDTH} {HEIGHT}">'
        f'<path d="{axes}" fill="none" stroke="currentColor" stroke-opacity="0.3"/>'
        f'<polyline points="{points}" fill="none" stroke="#2f7fb8" stroke-width="2"/>{labels}</svg>'
    )
