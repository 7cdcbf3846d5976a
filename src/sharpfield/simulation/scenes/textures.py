"""Closed-form textures, antialiased for the width of a pixel.

A texture gives, at coordinates (u, v) on a surface, how much of a second colour (`ink`) and of a
third (`accent`) covers the first. Every edge is as soft as the footprint of a pixel, and patterns
finer than a pixel fade to their mean, so images have no aliasing, and light is a smooth function of
the ray, however small the image.

Everything here is compiled and called once per ray; lengths are world units. It is compiled into
`surfaces.trace`, whose cache does not notice a change in this file: run `make clean` after one.
"""

from math import cos, floor, hypot, sin
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float32
from numba import njit

SOLID, CHECKS, STRIPES, TILES, BRICKS, LEAVES, MARBLE, WOOD, TEXT = range(9)
"""The textures."""

PAGE = 320
"""Longest side of a page of text, in samples."""
PAGE_INK = 0.22
"""Approximate fraction of a page that letters cover; text fades to it when a pixel is too wide."""


def page(text: str, aspect: float) -> Float32[np.ndarray, "h w"]:
    """Lettering as the signed distance to the edge of its strokes, in samples, inside positive.

    Args:
        text: Lines are separated by newlines; each is as large as fits.
        aspect: Width over height of the surface it is printed on. The longer side has `PAGE`
            samples.
    """
    width, height = (PAGE, round(PAGE / aspect)) if aspect > 1 else (round(PAGE * aspect), PAGE)
    canvas = np.zeros((height, width), np.uint8)
    lines = text.split("\n")
    face = cv2.FONT_HERSHEY_SIMPLEX
    for row, line in enumerate(lines):
        (w, h), _ = cv2.getTextSize(line, face, 10.0, 1)
        scale = 10.0 * min(0.86 * width / w, 0.62 * height / len(lines) / h)
        thick = max(round(h * scale / 10.0 * 0.2), 1)
        (w, h), _ = cv2.getTextSize(line, face, scale, 1)
        place = ((width - w) // 2, round((row + 0.5) * height / len(lines) + h / 2))
        cv2.putText(canvas, line, place, face, scale, 255, thick, cv2.LINE_AA)
    inked = (canvas > 127).astype(np.uint8)
    inside = cv2.distanceTransform(inked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - inked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (np.maximum(inside - 0.5, 0) - np.maximum(outside - 0.5, 0)).astype(np.float32)


@njit(cache=True, fastmath=True)
@no_type_check
def soft(distance, width):
    """0 outside, 1 inside, smooth over one `width` around the edge where `distance` is 0."""
    t = min(max(distance / width + 0.5, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True, fastmath=True)
@no_type_check
def band(distance, half, width):
    """Fraction of a pixel that a line covers, however thin; `distance` is from its middle."""
    return soft(half - distance, width) - soft(-half - distance, width)


@njit(cache=True, fastmath=True)
@no_type_check
def kept(width, period):
    """Contrast of a pattern of this period that remains for a pixel of `width`."""
    return 1.0 - min(max((width / period - 0.35) / 0.4, 0.0), 1.0)


@njit(cache=True, fastmath=True)
@no_type_check
def paint(kind, u, v, width, scale, seed, slant):
    """Fractions of ink and accent at (u, v).

    Args:
        kind: One of the textures.
        u: Place on the surface.
        v: Place on the surface.
        width: Footprint of a pixel there.
        scale: Cells per world unit.
        seed: Another seed, another pattern of the same kind.
        slant: How far stripes lean.
    """
    u, v, width = u * scale, v * scale, width * scale  # from here on in cells
    if kind == CHECKS:
        same = _wave(u, width) * _wave(v, width) * kept(width, 1.0)
        return 0.5 + 0.5 * same, 0.0
    if kind == STRIPES:
        return 0.5 + 0.5 * _wave(u + slant * v, width) * kept(width, 1.0), 0.0
    if kind == TILES:
        return _tiles(u, v, width, seed)
    if kind == BRICKS:
        return _bricks(u, v, width, seed)
    if kind == LEAVES:
        return _leaves(u, v, width, seed)
    if kind == MARBLE:
        cloud = _noise(u, v, width, seed)
        vein = abs(sin(3.0 * u + 2.0 * v + 7.0 * cloud))
        return cloud, soft(0.3 - vein, 0.3 + 8.0 * width) * kept(width, 0.4)
    if kind == WOOD:
        grain = _noise(0.35 * u, 4.0 * v, 4.0 * width, seed)
        ring = sin(11.0 * (v + 0.35 * _noise(0.3 * u, v, width, seed + 1)))
        return 0.5 * grain + (0.25 + 0.25 * ring) * kept(width, 0.55), 0.0
    return 0.0, 0.0


@njit(cache=True, fastmath=True)
@no_type_check
def letters(distances, u, v, width):
    """Fraction of ink on a page.

    Args:
        distances: The page.
        u: 0 at its left edge, 1 at its right.
        v: 0 at its top, 1 at its bottom.
        width: Footprint of a pixel, in samples of the page.
    """
    rows, columns = distances.shape
    x = min(max(u * columns - 0.5, 0.0), columns - 1.001)
    y = min(max(v * rows - 0.5, 0.0), rows - 1.001)
    i, j = int(y), int(x)
    a, b = x - j, y - i
    top = distances[i, j] * (1 - a) + distances[i, j + 1] * a
    bottom = distances[i + 1, j] * (1 - a) + distances[i + 1, j + 1] * a
    ink = soft(top * (1 - b) + bottom * b, max(width, 1.0))
    keep = kept(width, 0.25 * rows)
    return PAGE_INK + (ink - PAGE_INK) * keep


@njit(cache=True, fastmath=True)
@no_type_check
def _wave(x, width):
    """A square wave of period 2 between -1 and 1, its edges `width` wide."""
    along = x - 2.0 * floor(0.5 * x)  # 0...2
    to_edge = 0.5 - abs((along if along < 1.0 else along - 1.0) - 0.5)
    height = min(to_edge / (0.5 * width), 1.0)
    return height if along < 1.0 else -height


@njit(cache=True, fastmath=True)
@no_type_check
def _random(i, j, seed):
    """A number 0...1 for each cell."""
    n = (i * 374761393 + j * 668265263 + seed * 974711) & 0xFFFFFFFF
    n = ((n ^ (n >> 13)) * 1274126177) & 0xFFFFFFFF
    n = ((n ^ (n >> 15)) * 2246822519) & 0xFFFFFFFF
    return ((n ^ (n >> 16)) & 0xFFFFFF) / 16777216.0


@njit(cache=True, fastmath=True)
@no_type_check
def _noise(u, v, width, seed):
    """Four octaves of value noise, 0...1; octaves finer than a pixel are left at their mean."""
    total, weight, sum_weight = 0.0, 1.0, 0.0
    for octave in range(4):
        i, j = int(floor(u)), int(floor(v))
        a, b = u - i, v - j
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        s = seed + 31 * octave
        top = _random(i, j, s) * (1 - a) + _random(i + 1, j, s) * a
        bottom = _random(i, j + 1, s) * (1 - a) + _random(i + 1, j + 1, s) * a
        total += weight * (0.5 + (top * (1 - b) + bottom * b - 0.5) * kept(width, 1.5))
        sum_weight += weight
        u, v, width, weight = 2.1 * u, 2.1 * v, 2.1 * width, 0.6 * weight
    return total / sum_weight


@njit(cache=True, fastmath=True)
@no_type_check
def _tiles(u, v, width, seed):
    """Painted tiles: a flower of four petals, arcs around the corners, a grout line."""
    i, j = int(floor(u)), int(floor(v))
    x, y = u - i - 0.5, v - j - 0.5
    radius = hypot(x, y)
    square = x * x / max(radius * radius, 1e-12)
    four = 8.0 * square * (square - 1.0) + 1.0  # cosine of four times the angle
    petals = soft(0.26 + 0.11 * (four if (i + j) & 1 else -four) - radius, width)
    heart = soft(0.09 - radius, width)
    corner = hypot(0.5 - abs(x), 0.5 - abs(y))
    arcs = band(abs(corner - 0.27), 0.06, width)
    grout = band(0.5 - max(abs(x), abs(y)), 0.025, width)
    ink = max(petals * (1.0 - heart), 0.55 * grout)
    accent = max(arcs * (1.0 - ink), heart) * (0.75 + 0.25 * _random(i, j, seed))
    keep = kept(width, 0.5)
    return 0.3 + (ink - 0.3) * keep, 0.2 + (accent - 0.2) * keep


@njit(cache=True, fastmath=True)
@no_type_check
def _bricks(u, v, width, seed):
    """Bricks of many shades in running bond, twice as wide as high; accent is mortar."""
    row = int(floor(2.0 * v))
    shifted = u + 0.5 * (row & 1)
    column = int(floor(shifted))
    x, y = shifted - column, 2.0 * v - row
    to_edge = min(min(x, 1.0 - x), 0.5 * min(y, 1.0 - y))
    mortar = band(to_edge, 0.035, width)
    shade = 0.75 * _random(column, row, seed) + 0.25 * _noise(6.0 * u, 6.0 * v, 6.0 * width, seed)
    keep = kept(width, 0.6)
    mortar = 0.15 + (mortar - 0.15) * keep
    return (0.45 + (shade - 0.45) * keep) * (1.0 - mortar), mortar


@njit(cache=True, fastmath=True)
@no_type_check
def _leaves(u, v, width, seed):
    """Overlapping leaves with a midrib; each has its own shade, some have turned (accent)."""
    i, j = int(floor(u)), int(floor(v))
    ink, accent = 0.15, 0.0
    for layer in range(2):
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a, b, s = i + di, j + dj, seed + 57 * layer
                x = u - a - _random(a, b, s)
                y = v - b - _random(a, b, s + 1)
                if x * x + y * y > 0.4:
                    continue
                turn = 6.2832 * _random(a, b, s + 2)
                along = cos(turn) * x + sin(turn) * y
                across = cos(turn) * y - sin(turn) * x
                half = 0.27 * (1.0 - (along / 0.62) ** 2)
                cover = soft(half - abs(across), width)
                rib = band(abs(across), 0.025, width) * 0.5
                shade = 0.3 + 0.7 * _random(a, b, s + 3) - rib
                turned = 0.8 if _random(a, b, s + 4) > 0.86 else 0.0
                ink += cover * (shade * (1.0 - turned) - ink)
                accent += cover * (turned - accent)
    keep = kept(width, 0.6)
    return 0.45 + (ink - 0.45) * keep, 0.1 + (accent - 0.1) * keep
