"""Mistakes of the writer of a recording are undone while it is read."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from sharpfield.captures.native import layout as native
from sharpfield.core.events import EventStream
from sharpfield.preparation.ingest.options import AxisFixes, fixed_axes
from sharpfield.recordings.recording import Recording
from tests.cli.command import run
from tests.recordings.captured import expect_equal_events
from tests.streams import HEIGHT, WIDTH, random_events


def spoiled(events: EventStream, fixes: AxisFixes) -> EventStream:
    """What a program with these fixes would have written."""
    x, y, width, height = events.x, events.y, events.width, events.height
    x = width - 1 - x if fixes.flip_x else x
    y = height - 1 - y if fixes.flip_y else y
    p = -events.p if fixes.flip_polarity else events.p
    if fixes.swap_xy:
        x, y, width, height = y, x, height, width
    return replace(
        events,
        x=x.astype(events.x.dtype),
        y=y.astype(events.x.dtype),
        p=p.astype(np.int8),
        width=width,
        height=height,
    )


ALL = [AxisFixes(*parts) for parts in product((False, True), repeat=4)]


@pytest.mark.parametrize("fixes", ALL, ids=str)
def test_each_mixture_of_fixes_is_undone(fixes: AxisFixes) -> None:
    true = random_events(500)
    wrong = spoiled(true, fixes)
    size = (wrong.width, wrong.height)
    recording = Recording(
        Path("x"), "made up", size, events=lambda: iter([wrong[:200], wrong[200:]])
    )
    found = fixed_axes(recording, fixes)
    assert found.size == (WIDTH, HEIGHT)
    expect_equal_events(found.load(), true)
    assert (found.layout == "made up") == (fixes == AxisFixes())


def test_options_of_ingest_undo_fixes_of_a_text(tmp_path: Path) -> None:
    true = random_events(500)
    fixes = AxisFixes(swap_xy=True, flip_y=True, flip_polarity=True)
    wrong = spoiled(true, fixes)
    table = np.column_stack([wrong.t_us, wrong.x, wrong.y, wrong.p > 0])
    np.savetxt(tmp_path / "events.txt", table, "%d")
    words = ("--unit", "us", "--size", f"{WIDTH}x{HEIGHT}", "--hot", 0)
    flags = ("--swap-xy", "--flip-y", "--flip-polarity")
    assert run("ingest", tmp_path / "events.txt", "--out", tmp_path / "cap", *words, *flags) == 0
    found = native.read_unposed(tmp_path / "cap")
    for name in ("x", "y", "t_us", "p"):
        np.testing.assert_array_equal(
            getattr(found.needed_events, name), getattr(true, name), err_msg=name
        )
    assert "x and y swapped" in found.source
