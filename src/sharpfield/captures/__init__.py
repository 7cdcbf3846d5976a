"""From disk to captures, and from captures to what a training step looks at."""

from sharpfield.captures.draw import (
    PairTable,
    PixelTable,
    draw_chains,
    draw_pairs,
    draw_pixels,
    draw_silent,
    pair_table,
    pixel_table,
)
from sharpfield.captures.event_cache import event_index, read_events
from sharpfield.captures.fused_points import FusedPoints, as_points, fuse_points
from sharpfield.captures.native import write
from sharpfield.captures.read import LAYOUTS, Layout, layout_of, read, read_unposed
from sharpfield.captures.summary import capture_summary, summary

__all__ = [
    "FusedPoints",
    "LAYOUTS",
    "Layout",
    "PairTable",
    "PixelTable",
    "as_points",
    "capture_summary",
    "draw_chains",
    "draw_pairs",
    "draw_pixels",
    "draw_silent",
    "event_index",
    "fuse_points",
    "layout_of",
    "pair_table",
    "pixel_table",
    "read",
    "read_events",
    "read_unposed",
    "summary",
    "write",
]
